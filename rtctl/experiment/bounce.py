"""Sampling pumps energy: a unit mass that bounces off the FIRAS field, over servo rates, against the analytic value."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtctl.control.firas import FieldParams, eta_of, field_params, firas
from rtctl.experiment.mass import turning_distance
from rtctl.experiment.scene import Say, unsaid
from rtctl.experiment.style import BLUE, GREEN, INK, ORANGE, RED, SKY, level, note, page
from rtctl.plain import Json
from rtctl.types import F64

TITLE = "Energy of a sampled bounce"
CAPTION = "speed at which a mass leaves the field, over the servo rate; the bound, and what damping makes of it"
V_MAX, INFLUENCE, CLEARANCE = 0.5, 0.1, 0.02  # [m/s], [m], [m]
RATES = (100.0, 150.0, 225.0, 350.0, 500.0, 700.0, 1000.0, 2000.0, 4000.0)  # [Hz]
SHOWN = (1000.0, 225.0, 100.0)  # [Hz] drawn as orbits
PHASES = 24  # moments within a period at which the mass may enter
SPEEDS = (0.25, 0.5, 0.75, 1.0)  # of v_max, over which the bound is held
DELAY = 1.5  # [periods] mean age of the force: one sample of delay, and half a period while it is held


class Orbit(NamedTuple):
    """One bounce, a row a period."""

    rho: F64  # (T,) [m]
    v: F64  # (T,) [m/s]


class Data(NamedTuple):
    """Leaving over entering speed, by rate (k)."""

    rates: F64  # (k,) [Hz]
    plain: F64  # (k,) worst over phases, without cap and damping, entering at v_max
    worst: F64  # (k,) the same, worst over entering speeds up to v_max too
    capped: F64  # (k,) with the cap below rho_num
    damped: F64  # (k,) the field as it is used: cap and one-sided damping
    orbits: dict[float, Orbit]  # plain, by rate [Hz]
    depth: F64  # (k,) [m] least distance of the field as it is used


def bounce(params: FieldParams, dt: float, speed: float, phase: float = 0.0) -> Orbit:
    """Return the bounce of a unit mass that enters at `speed` [m/s], `phase` periods after a sample.

    The force of the state one sample ago is held for a period, as a servo on a bus does it.
    """
    x, v = params.rho0 + phase * speed * dt, -speed
    before = (x, v)
    rho, vel = [x], [v]
    while not (v > 0.0 and before[0] > params.rho0):
        a, d = firas(*before, *params[:5])
        before = (x, v)
        x, v = x + v * dt + 0.5 * (a + d) * dt * dt, v + (a + d) * dt
        rho.append(x)
        vel.append(v)
        if x > params.rho0 and v <= 1e-3 * speed:  # damping has taken all but a creep
            break
    return Orbit(np.array(rho), np.array(vel))


def gain(speed: float, dt: float) -> float:
    """Return c, the energy that the delay pumps in, of the kinetic energy: dE = delay int K v^2 dt to first order.

    With s = 1/rho - 1/rho0, a = eta s/rho^2, K = -da/drho and v^2 = V^2 - eta s^2, the integral is closed:
    c = 4 delay V (3 pi s_m/16 + 4/(3 rho0) + pi/(4 rho0^2 s_m)), s_m = V/sqrt(eta).
    """
    s = speed / float(np.sqrt(eta_of(V_MAX, INFLUENCE, CLEARANCE)))
    turn = 3.0 * np.pi * s / 16.0 + 4.0 / (3.0 * INFLUENCE) + np.pi / (4.0 * INFLUENCE**2 * s)
    return float(4.0 * DELAY * dt * speed * turn)


def first_order(speed: float, dt: float) -> float:
    """Return leaving over entering speed to first order in the delay, sqrt(1 + c)."""
    return float(np.sqrt(1.0 + gain(speed, dt)))


def bound(speed: float, dt: float) -> float:
    """Return the bound on leaving over entering speed: 1/sqrt(1 - c), the gain counted at the speed of leaving.

    Infinite from c = 1 on: at such rates nothing is promised of an undamped mass.
    """
    c = gain(speed, dt)
    return float(1.0 / np.sqrt(1.0 - c)) if c < 1.0 else float("inf")


def run(say: Say = unsaid, rates: tuple[float, ...] = RATES, phases: int = PHASES) -> Data:
    """Bounce at every rate, phase and speed."""
    rows, orbits = [], {}
    for k, rate in enumerate(rates):
        dt = 1.0 / rate
        used = field_params(V_MAX, INFLUENCE, CLEARANCE, dt, 1.0, 0.0, 1e3)
        plain, capped = used._replace(k_d=0.0, rho_num=1e-4), used._replace(k_d=0.0)
        moments = np.linspace(0.0, 1.0, phases, endpoint=False)
        at = [[_left(plain, dt, part * V_MAX, float(p)) for p in moments] for part in SPEEDS]
        full = max(at[-1])
        rows.append(
            (
                full,
                max(map(max, at)),
                max(_left(capped, dt, V_MAX, float(p)) for p in moments),
                max(_left(used, dt, V_MAX, float(p)) for p in moments),
                min(float(bounce(used, dt, V_MAX, float(p)).rho.min()) for p in moments),
            )
        )
        if rate in SHOWN:
            orbits[rate] = bounce(plain, dt, V_MAX)
        say((k + 1) / len(rates))
    plain_, worst, capped_, damped, depth = np.array(rows).T
    return Data(np.array(rates), plain_, worst, capped_, damped, orbits, depth)


def _left(params: FieldParams, dt: float, speed: float, phase: float) -> float:
    return float(bounce(params, dt, speed, phase).v[-1]) / speed


def figures(data: Data) -> Json:
    """Return the numbers of the figure."""
    bounds = [bound(V_MAX, 1.0 / r) for r in data.rates]
    return {
        "v_max_m_s": V_MAX,
        "rate_Hz": data.rates.tolist(),
        "leaves_plain": data.plain.tolist(),
        "leaves_worst_speed": data.worst.tolist(),
        "leaves_capped": data.capped.tolist(),
        "leaves_damped": data.damped.tolist(),
        "least_distance_damped_m": data.depth.tolist(),
        "first_order": [first_order(V_MAX, 1.0 / r) for r in data.rates],
        "bound": [b if np.isfinite(b) else None for b in bounds],
    }


def draw(data: Data) -> Figure:
    """Return the figure."""
    at = {float(r): float(p) for r, p in zip(data.rates, data.plain, strict=True)}
    words = ",  ".join(f"{at[r]:.2f} V at {r:.0f} Hz" for r in SHOWN if r in at)
    figure = page("A sampled field pumps energy", f"A mass that enters at V, without damping, leaves at {words}")
    grid = figure.add_gridspec(1, 2, left=0.08, right=0.985, top=0.80, bottom=0.11, wspace=0.24)
    _orbits(figure.add_subplot(grid[0]), data)
    _leaving(figure.add_subplot(grid[1]), data)
    return figure


def _orbits(axes: Axes, data: Data) -> None:
    eta = eta_of(V_MAX, INFLUENCE, CLEARANCE)
    least = turning_distance(V_MAX, field_params(V_MAX, INFLUENCE, CLEARANCE, 1e-3, 1.0, 0.0, 1e3))
    rho = np.concatenate([[INFLUENCE * 1.4], np.geomspace(INFLUENCE, least, 200)])
    v = np.sqrt(np.maximum(V_MAX**2 - eta * np.maximum(1.0 / rho - 1.0 / INFLUENCE, 0.0) ** 2, 0.0))
    axes.plot(
        1e3 * np.concatenate([rho, rho[::-1]]),
        np.concatenate([-v, v[::-1]]),
        color=INK,
        lw=1.3,
        ls=(0, (2, 2)),
        label="continuous",
    )
    for (rate, orbit), colour in zip(data.orbits.items(), (BLUE, ORANGE, RED), strict=False):
        marker = "o" if rate < 300.0 else "None"
        axes.plot(1e3 * orbit.rho, orbit.v, color=colour, lw=2.0, label=f"{rate:.0f} Hz", marker=marker, ms=4.5)
    axes.axvspan(0.0, 1e3 * CLEARANCE, color=RED, alpha=0.10, lw=0)
    note(axes, 10, 1.22, "clear-\nance", RED, ha="center", va="top")
    axes.axvline(1e3 * INFLUENCE, color=SKY, lw=1.5, ls=(0, (5, 3)))
    note(axes, 1e3 * INFLUENCE + 1.5, -0.62, "influence", BLUE, ha="left", va="top")
    axes.axhline(0.0, color=INK, lw=0.8)
    axes.set_xlim(0.0, 128.0)
    axes.set_ylim(-0.75, 1.35)
    axes.grid(True)
    axes.set_xlabel("distance to the surface [mm]")
    axes.set_ylabel("speed [m/s]", labelpad=2)
    axes.set_title("In (below) at 0.5 m/s, and out again (above)")
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.42))


def _leaving(axes: Axes, data: Data) -> None:
    f = np.geomspace(90.0, 4500.0, 400)
    limit = np.array([bound(V_MAX, 1.0 / x) for x in f])
    axes.fill_between(f, np.minimum(limit, 9.0), 9.0, color=RED, alpha=0.10, lw=0)
    axes.plot(f, limit, color=RED, lw=1.5, ls=(0, (5, 3)), label=r"bound $1/\sqrt{1-c}$")
    axes.plot(f, [first_order(V_MAX, 1.0 / x) for x in f], color=INK, lw=1.5, label=r"first order $\sqrt{1+c}$")
    axes.plot(data.rates, data.worst, "o", ms=9, mfc="none", mec=BLUE, mew=2.0, label="undamped, worst")
    axes.plot(data.rates, data.damped, "s", ms=8, mfc=GREEN, mec=GREEN, label="as used: damped")
    level(axes, 1.0, "no gain", INK, at=0.99, above=False)
    axes.set_xscale("log")
    axes.set_xticks([100, 225, 500, 1000, 2000, 4000], ["100", "225", "500", "1000", "2000", "4000"])
    axes.minorticks_off()
    axes.set_xlim(90.0, 4500.0)
    axes.set_ylim(0.0, 2.7)
    axes.grid(True)
    axes.set_xlabel("servo rate [Hz]")
    axes.set_ylabel("speed out over speed in")
    axes.set_title("Over the servo rate")
    axes.legend(loc="upper right")
