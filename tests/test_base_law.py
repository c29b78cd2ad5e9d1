"""The base's mathematics, each against an oracle of its own, and the tick as a whole: pure, warm, replayed."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numba.core import event
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from firmware_sim.vehicle import Traits, Vehicle
from rtctl.app.replay import replay
from rtctl.app.rover_log import header_of
from rtctl.design.rover import build
from rtctl.errors import LogError
from rtctl.log import read
from rtctl.log.read.run import read_run
from rtctl.log.record.requests import decode_request
from rtctl.log.record.rover_scene import BaseScene
from rtctl.log.record.writer import McapSink
from rtctl.rover import estimator, faults, law, occupancy, path, pipe
from rtctl.rover.occupancy import CELL, SIZE, STENCIL
from rtctl.rover.record import feedback_from
from rtctl.rover.robot import SECTORS, Wheels
from rtctl.rover.signals import Ask, BaseFeedback, at_rest
from rtctl.spec.base import load
from rtctl.types import Link, ObstacleEdit, Request, Shape, State, Verb
from rtctl.world import obstacle_table
from tests.base_lab import ROVER, UPRIGHT, BaseLab, goal_at
from tests.bodies import box

BASE = build(load(ROVER), ROVER)
RANDOM = np.random.default_rng(5)


def charted(points) -> occupancy.Chart:
    """Return a chart with returns in the cells of points (m, 2) [m]."""
    empty = occupancy.empty(np.zeros(2))
    cells = empty.cells.copy()
    for i, j in np.floor(np.asarray(points) / CELL).astype(int) - empty.origin:
        cells[i, j] = 3
    return empty._replace(cells=cells)


def test_free_distance_is_the_euclidean_one_up_to_its_stencil():
    seen = charted(RANDOM.uniform(-20.0, 20.0, (60, 2)))
    free = occupancy.free_distance(seen, obstacle_table.empty().obstacles, 0.3)
    oracle = ndimage.distance_transform_edt(seen.cells == 0) * CELL
    np.testing.assert_allclose(free, np.minimum(oracle, STENCIL * CELL), atol=1e-9)


def test_told_obstacles_count_in_it_where_their_height_is_cut():
    box = Shape("b", "box", np.array([1.0, 2.0, 0.5, 0.0]), np.array([3.0, 1.0, 0.5]), UPRIGHT, *np.zeros((2, 3)))
    table, _ = obstacle_table.edited(obstacle_table.empty(), (ObstacleEdit("b", box),))
    seen = occupancy.empty(np.zeros(2))
    free = occupancy.free_distance(seen, table.obstacles, 0.3)
    x, y = ((np.indices((SIZE, SIZE)).transpose(1, 2, 0) + seen.origin + 0.5) * CELL).transpose(2, 0, 1)
    flat = np.hypot(np.maximum(np.abs(x - 3.0) - 1.0, 0.0), np.maximum(np.abs(y - 1.0) - 2.0, 0.0))
    np.testing.assert_allclose(free, np.minimum(flat, STENCIL * CELL), atol=1e-9)
    above = occupancy.free_distance(seen, table.obstacles, 2.0)
    assert above.min() == pytest.approx(1.0)


def test_a_scan_marks_what_it_touches_forgets_what_it_passes_and_follows_the_base():
    step = -2.0 * math.pi / SECTORS
    scan = np.full(SECTORS, np.inf)
    scan[0], scan[18] = 5.0, 3.0  # ahead, and to the right
    yaw = math.radians(90.0)
    look = occupancy.PlacedScan(np.array([1.0, 2.0]), yaw, step, scan, 12.0)
    seen = occupancy.integrate_scan(occupancy.empty(np.zeros(2)), look, 0)
    near = occupancy.returns_near(seen, np.array([1.0, 2.0]), 8.0)
    oracle = np.array([[1.0, 7.0], [4.0, 2.0]])
    assert len(near) == 2
    for at in oracle:
        assert np.abs(near - at).max(axis=1).min() <= 0.5 * CELL + 1e-9
    clear = np.full(SECTORS, np.inf)
    for _ in range(3):
        seen = occupancy.integrate_scan(seen, look._replace(ranges=clear), 0)
    assert not seen.cells.any()
    kept = charted([[10.0, 3.0]])
    away = occupancy.moved(kept, np.array([25.0, 0.0]))
    before, after = (occupancy.returns_near(c, np.array([10.0, 3.0]), 1.0) for c in (kept, away))
    np.testing.assert_allclose(after, before)
    assert occupancy.moved(kept, np.array([200.0, 0.0])).cells.sum() == 0


def test_the_way_is_as_short_as_brute_force_over_the_cells_finds_and_keeps_its_room():
    wall = [(8.0, y) for y in np.arange(-6.0, 6.0, 0.2)] + [(x, 6.0) for x in np.arange(2.0, 8.0, 0.2)]
    seen = charted(wall)
    free = occupancy.free_distance(seen, obstacle_table.empty().obstacles, 0.3)
    x, goal, room = np.zeros(2), np.array([16.0, 1.0]), 1.3
    way = path.way_to(free, seen.origin, x, goal, room, path.NO_WAY)
    assert way.short == 0.0
    shortest = _brute(free >= room, x, goal, seen.origin)
    assert way.length <= shortest + 0.5 * CELL  # pulled taut it is shorter than steps along cells
    assert way.length >= 0.92 * shortest
    corners = np.vstack([x, way.corners])
    for a, b in pairwise(corners):
        on = a + (b - a) * np.linspace(0.0, 1.0, 200)[:, None]
        cells = np.floor(on / CELL).astype(int) - seen.origin
        assert free[cells[:, 0], cells[:, 1]].min() >= room - 0.2 * CELL  # a line may cut the corner of a cell


def _brute(open_cells, x, goal, origin) -> float:
    """Return the shortest way [m] over open cells with eight neighbours."""
    number = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)
    rows, columns, costs = [], [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = number[: SIZE - di, max(0, -dj) : SIZE - max(0, dj)]
        b = number[di:, max(0, dj) : SIZE + min(0, dj)]
        both = open_cells.ravel()[a.ravel()] & open_cells.ravel()[b.ravel()]
        rows.append(a.ravel()[both])
        columns.append(b.ravel()[both])
        costs.append(np.full(both.sum(), math.hypot(di, dj)))
    graph = coo_matrix((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), (SIZE**2, SIZE**2))
    start, end = (number[tuple(np.floor(at / CELL).astype(int) - origin)] for at in (x, goal))
    return float(dijkstra(graph.tocsr(), directed=False, indices=start)[end]) * CELL


def test_a_way_once_chosen_is_kept_before_the_middle_of_a_wall_and_left_when_it_closes():
    wall = [(8.0, y) for y in np.arange(-5.0, 5.0, 0.2)]
    seen = charted(wall)
    free = occupancy.free_distance(seen, obstacle_table.empty().obstacles, 0.3)
    goal = np.array([16.0, 0.0])
    way = path.way_to(free, seen.origin, np.array([0.0, 0.4]), goal, 1.3, path.NO_WAY)
    side = np.sign(way.corners[0, 1])
    for y in (0.2, 0.0, -0.2, -0.4, 0.3, -0.3):
        way = path.way_to(free, seen.origin, np.array([0.0, y]), goal, 1.3, way)
        assert np.sign(way.corners[0, 1]) == side
    closed = charted(wall + [(8.0, side * y) for y in np.arange(5.0, 12.0, 0.2)])
    free = occupancy.free_distance(closed, obstacle_table.empty().obstacles, 0.3)
    way = path.way_to(free, closed.origin, np.array([0.0, 0.0]), goal, 1.3, way)
    assert np.sign(way.corners[0, 1]) == -side


def test_a_wall_whose_returns_move_by_a_cell_with_each_scan_does_not_change_the_side():
    goal, none = np.array([16.0, 0.0]), obstacle_table.empty().obstacles
    way, sides = path.NO_WAY, set()
    for k in range(24):
        x = np.array([0.15 * k, 0.02 * (-1) ** k])
        low, high = -5.0 - 0.7 * (k % 2), 5.0 + 0.7 * (1 - k % 2)
        wall = [(8.0 - 0.35 * (k % 3), y) for y in np.arange(low, high, 0.2)]
        seen = charted(wall)
        way = path.way_to(occupancy.free_distance(seen, none, 0.3), seen.origin, x, goal, 1.3, way)
        assert way.short == 0.0
        sides.add(float(np.sign(way.corners[0, 1])))
    assert len(sides) == 1


def test_the_push_of_returns_is_the_gradient_of_the_potential_and_does_not_grow_with_resolution():
    f = BASE.field

    def potential(x, at):
        rho = np.hypot(*(x - at)) - BASE.point_radius[0]
        return 0.5 * f.eta * (1.0 / rho - 1.0 / f.rho0) ** 2

    x, at, h = np.zeros(2), np.array([1.2, 0.5]), 1e-6
    none = obstacle_table.empty().obstacles
    push = law.field(BASE, x, 0.3, np.zeros(2), at[None], 1, none)
    slope = [(potential(x + h * e, at) - potential(x - h * e, at)) / (2.0 * h) for e in np.eye(2)]
    np.testing.assert_allclose(push.sensed, -np.array(slope), rtol=1e-6)
    wall = [np.column_stack([np.full(n, 1.2), np.linspace(-3.0, 3.0, n)]) for n in (61, 601)]
    coarse, fine = (law.field(BASE, x, 0.0, np.zeros(2), w, len(w), none).sensed for w in wall)
    np.testing.assert_allclose(coarse, fine, rtol=0.02, atol=1e-9)
    between = np.vstack([wall[0], wall[0] * (-1.0, 1.0)])
    np.testing.assert_allclose(law.field(BASE, x, 0.0, np.zeros(2), between, 0, none).sensed, 0.0, atol=1e-9)


def test_the_control_point_moves_as_the_reference_wants_while_nothing_saturates():
    for _ in range(50):
        yaw, v_ref = RANDOM.uniform(-3.1, 3.1), RANDOM.uniform(-0.6, 0.6, 2)
        v, w = law.unicycle(BASE._replace(limits=BASE.limits._replace(reverse=True)), v_ref, yaw)
        h = 1e-6
        point = [np.array([math.cos(a), math.sin(a)]) * BASE.ahead for a in (yaw, yaw + h * w)]
        moved = h * v * np.array([math.cos(yaw), math.sin(yaw)]) + point[1] - point[0]
        np.testing.assert_allclose(moved / h, v_ref, atol=1e-5)


def test_limits_of_the_wheels_hold_whatever_is_asked():
    car = BASE._replace(wheels=Wheels.ACKERMANN, limits=BASE.limits._replace(radius=2.0))
    for _ in range(300):
        yaw, v_ref = RANDOM.uniform(-3.1, 3.1), RANDOM.uniform(-2.0, 2.0, 2)
        v, w = law.unicycle(BASE, v_ref, yaw)
        assert v >= 0.0  # reversing is not allowed
        assert abs(w) <= BASE.limits.w_max
        v, w = law.unicycle(car, v_ref, yaw)
        assert abs(w) * 2.0 <= abs(v) + 1e-9


@pytest.mark.parametrize("speed", [2.0, 1.0, 0.3, 0.01, 1e-5])
def test_what_is_behind_is_turned_to_on_the_spot_no_faster_than_the_reference_moves(speed: float):
    for angle in np.linspace(0.51 * math.pi, 1.49 * math.pi, 25):  # straight behind among them: it must turn, not wait
        v, w = law.unicycle(BASE, speed * np.array([math.cos(angle), math.sin(angle)]), 0.0)
        assert v == 0.0
        assert abs(w) == pytest.approx(min(BASE.limits.w_max, speed / BASE.ahead))
        assert w * math.sin(angle) >= -1e-12  # the short way round


def test_v_ref_stays_under_v_max_and_a_max_when_the_goal_jumps():
    v, dt = np.zeros(2), BASE.dt
    for _ in range(500):
        target, push = RANDOM.uniform(-50, 50, 2), RANDOM.uniform(-30, 30, 2)
        xd = law.desired(BASE, np.zeros(2), target, float(np.hypot(*target)))
        assert np.hypot(*xd) <= BASE.limits.v_max + 1e-12
        new = law.integrated(BASE, v, xd, push, dt)
        assert np.hypot(*(new - v)) <= 1.5 * BASE.limits.a_max * dt + 1e-12
        assert np.hypot(*new) <= BASE.limits.v_max + 1e-12
        v = new


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_from_the_speed_that_the_governor_allows_the_vehicle_stops_short_of_what_is_ahead(speed):
    traits = Traits("skid", 2.1, 1.6, 2.0)
    car = Vehicle(traits)
    for _ in range(200):
        car.step(speed, 0.0, 0.0, 0.02)
    sent = np.full(law.history(BASE), speed)
    wall = np.array([[car.x + 6.0, y] for y in np.arange(-3.0, 3.0, 0.1)])
    none = obstacle_table.empty().obstacles
    for _ in range(600):
        x = np.array([car.x, car.y])
        push = law.field(BASE, x, 0.0, np.zeros(2), wall, len(wall), none)
        coming = law.ahead_of(BASE, x, 0.0, np.column_stack([sent, 0.0 * sent]))[0][0] - car.x
        course = law.Course(np.array([*x, 0.0]), np.array([1.0, 0.0]), coming, False)
        v = min(speed, law.allowed_speed(BASE, course, wall, none, push))
        sent = np.concatenate([[v], sent[:-1]])
        car.step(v, 0.0, 0.0, 0.02)
    assert wall[0, 0] - car.x - BASE.margins.hull >= BASE.margins.stop - 0.05


def test_the_governor_sees_told_obstacles_as_far_off_as_they_are():
    ball = Shape("b", "sphere", np.array([0.7, 0, 0, 0]), np.array([5.0, 0.4, 0.3]), UPRIGHT, *np.zeros((2, 3)))
    table, _ = obstacle_table.edited(obstacle_table.empty(), (ObstacleEdit("b", ball),))
    r = BASE.margins.hull + BASE.margins.stop
    gap = law._gap_known(np.zeros((1, 2)), np.array([1.0, 0.0]), np.array([r]), 0.3, table.obstacles, 30.0)
    assert gap == pytest.approx(5.0 - math.sqrt((0.7 + r) ** 2 - 0.4**2), abs=0.02)
    assert law._gap_known(np.zeros((1, 2)), np.array([0.0, 1.0]), np.array([r]), 0.3, table.obstacles, 30.0) == math.inf


def test_estimate_is_filterpys_on_the_same_model():
    noise, dt = BASE.noise, 0.02
    e = estimator.start(np.array([1.0, -2.0]), 0.0, noise)
    oracle = KalmanFilter(3, 2)
    oracle.x, oracle.P = np.array([1.0, 0.0, 0.0]), e.P.copy()
    oracle.F = np.array([[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    g = np.array([0.5 * dt * dt, dt, 0.0])
    oracle.Q = noise.acceleration**2 * np.outer(g, g) + np.diag([0.0, 0.0, estimator.BIAS_WALK**2 * dt])
    for _ in range(50):
        e = estimator.predicted(e, dt, noise)
        oracle.predict()
        z, v, age = RANDOM.normal(1.0, 0.1, 2), RANDOM.normal(0.0, 0.1, 2), RANDOM.uniform(0.0, 0.1)
        e, _ = estimator.measured(e, z, v, age, noise)
        R = np.diag(
            [
                noise.position**2 + (0.5 * noise.acceleration * age**2) ** 2,
                noise.velocity**2 + (noise.acceleration * age) ** 2,
            ]
        )
        oracle.update(np.array([z[0], v[0]]), R=R, H=np.array([[1.0, -age, 0.0], [0.0, 1.0, 1.0]]))
        np.testing.assert_allclose([e.x[0], e.v[0], e.b[0]], oracle.x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(e.P, oracle.P, rtol=1e-9, atol=1e-15)


def healthy(**changes) -> BaseFeedback:
    return at_rest(np.zeros(2), 0.0)._replace(ours=True, armed=True, scan_age=0.0, **changes)


@pytest.mark.parametrize(
    ("name", "feedback", "times"),
    [
        ("send_failed", {"link": int(Link.SEND_FAILED)}, 10),
        ("link_down", {"link": int(Link.DOWN)}, 1),
        ("log_degraded", {"link": int(Link.LOG_DEGRADED)}, 1),
        ("deadline", {"missed": 10}, 1),
        ("not_finite", {"position": np.array([np.nan, 0.0])}, 1),
    ],
)
def test_faults_of_the_machine_are_seen_in_the_tick_that_has_them(name, feedback, times):
    m = pipe.initial(BASE, healthy())._replace(state=State.RUN, entered=True, mine=True)
    for k in range(times):
        assert name not in faults.names(m.in_force)
        m, command, _ = pipe.tick(BASE, m, healthy(slot=k, **feedback), Request())
    assert name in faults.names(m.in_force)
    severe = faults.TABLE.by_name[name].severity
    assert (m.state == State.SAFE_STOP) == (severe >= faults.Severity.SS2)
    assert math.isfinite(command.v)
    assert math.isfinite(command.w)


def test_obstacles_that_touch_hold_the_goal_or_grow_stale_stop_the_base():
    lab = BaseLab().armed()
    crate = Shape("c", "box", np.array([0.5, 0.5, 0.5, 0]), np.array([0.8, 0.0, 0.3]), UPRIGHT, *np.zeros((2, 3)))
    lab.tick(obstacles=(ObstacleEdit("c", crate),))
    lab.tick()
    assert "contact" in lab.faults
    assert lab.m.state == State.SAFE_STOP
    lab = BaseLab().armed()
    lab.tick(goal=goal_at(10.0, 0.0))
    lab.tick(obstacles=(ObstacleEdit("c", crate._replace(position=np.array([10.0, 0.0, 0.3]))),))
    lab.tick()
    assert "goal_in_obstacle" in lab.faults
    lab.tick(goal=goal_at(10.0, 0.1))
    assert "inside obstacle c" in lab.m.refusal
    moving = crate._replace(position=np.array([20.0, 5.0, 0.3]), velocity=np.array([0.1, 0.0, 0.0]))
    lab.tick(obstacles=(ObstacleEdit("*", None), ObstacleEdit("m", moving)))
    assert lab.run(1.0, lambda: "feed_stale" in lab.faults)
    assert lab.asks[-1] == Ask.DRIVE  # zero twist is streamed
    assert lab.m.v == 0.0


def test_goals_that_make_no_sense_are_refused_with_the_reason():
    lab = BaseLab()
    lab.tick(goal=goal_at(5.0, 0.0))
    assert "not possible in state IDLE" in lab.m.refusal
    lab.armed()
    lab.tick(goal=goal_at(400.0, 400.0))
    assert "reach" in lab.m.refusal
    lab.tick(goal=goal_at(math.nan, 0.0))
    assert "finite" in lab.m.refusal
    lab.tick(Verb.RECOVER)
    assert "no joint limits" in lab.m.refusal


def test_a_log_replays_to_the_same_bytes_and_nothing_compiles_after_warm(tmp_path):
    pipe.warm(BASE)
    compiled: list[str] = []
    disc = {"name": "d", "type": "cylinder", "radius_m": 1.0, "length_m": 2.0, "position_m": [8.0, 0.2, 0.0]}
    probe = BaseLab(obstacles=[disc])
    sink = McapSink(tmp_path / "run.mcap", header_of(probe.config, ROVER, probe.base, probe.start))
    with event.install_listener("numba:compile", _Listener(compiled)):
        lab = BaseLab(obstacles=[disc], sink=sink).driving(16.0, 0.0, seconds=6.0)
    assert compiled == []
    sink.close("end")
    log = read(tmp_path / "run.mcap")
    requests = dict(decode_request(p) for p in log["/request"].payloads)
    rows = log["/tick"].array
    m = pipe.initial(lab.base, lab.start)
    for k, row in enumerate(rows):
        m, _, record = pipe.tick(lab.base, m, feedback_from(row), requests.get(k, Request()))
        assert record.tobytes() == row.tobytes(), k
    assert len(rows) > 300


class _Listener(event.Listener):
    def __init__(self, found):
        self.found = found

    def on_start(self, e):
        self.found.append(str(e.data.get("dispatcher")))

    def on_end(self, e):
        pass


def test_a_log_carries_the_files_that_its_configs_obstacles_come_from(tmp_path: Path):
    config, shape = tmp_path / "rover.toml", box(1.0, 1.0, 1.0)
    lines = [f"v {x} {y} {z}" for x, y, z in shape.V] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in shape.T]
    (tmp_path / "rock.obj").write_text("\n".join(lines))
    np.save(tmp_path / "heap.npy", RANDOM.uniform(-0.5, 0.5, (50, 3)))
    files = ('type = "mesh"\nfile = "rock.obj"', 'type = "cloud"\nfile = "heap.npy"\npoint_radius_m = 0.1')
    obstacles = [f'[[obstacle]]\nname = "o{k}"\nposition_m = [9.0, 0.0, 0.0]\n{file}' for k, file in enumerate(files)]
    config.write_text("\n".join([ROVER.read_text(), *obstacles]))
    base = build(load(config), config)
    McapSink(tmp_path / "run.mcap", header_of(load(config), config, base, at_rest(np.zeros(2), 0.0))).close("end")
    for name in ("rock.obj", "heap.npy", "rover.toml"):
        (tmp_path / name).unlink()
    with pytest.raises(LogError, match="no tick in it"):  # it gets that far
        replay(read_run(tmp_path / "run.mcap"))
    drawn = [shape["type"] for shape in BaseScene(read_run(tmp_path / "run.mcap").header).shapes()]
    assert drawn == ["mesh", "cloud"]
