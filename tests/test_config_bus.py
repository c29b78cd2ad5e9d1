"""The bus budget is the published one, and no frame the kernel could send is longer than we say."""

import random

import pytest

from rtctl.spec.bus import classic_bits, cycle_load, fd_bits, frame_time


def stuffed(bits: list[int]) -> int:
    """Return the number of stuff bits that CAN inserts: one after five equal bits, itself counted in the next run."""
    count, run, last = 0, 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            count, last, run = count + 1, 1 - bit, 1
    return count


def test_a_classic_frame_of_8_bytes_takes_135_bits_of_which_111_are_unstuffed() -> None:
    assert classic_bits(8) == 135
    assert classic_bits(8) - (34 + 64 - 1) // 4 == 111


@pytest.mark.parametrize(("data_rate", "microseconds"), [(5e6, (56.6, 64.6, 169.6)), (8e6, (48.1, 53.1, 118.8))])
def test_fd_frames_take_the_published_times(data_rate: float, microseconds: tuple[float, ...]) -> None:
    for size, expected in zip((8, 12, 64), microseconds, strict=True):
        assert 1e6 * frame_time(size, 1e6, data_rate) == pytest.approx(expected, abs=0.051)


@pytest.mark.parametrize(
    ("payload", "data_rate", "period", "microseconds", "percent"),
    [
        (8, None, 2e-3, 1890, 94),
        (8, None, 1e-3, 1890, 189),
        (8, 5e6, 1e-3, 792, 79),
        (12, 5e6, 1e-3, 904, 90),
        (12, 8e6, 1e-3, 744, 74),
        (12, 8e6, 2e-3, 744, 37),
    ],
)
def test_the_cycle_of_7_joints_is_the_published_one(
    payload: int, data_rate: float | None, period: float, microseconds: float, percent: float
) -> None:
    load = cycle_load(7, payload, 1e6, data_rate, period)
    assert 1e6 * load.cycle == pytest.approx(microseconds, abs=0.51)
    assert 100 * load.ratio == pytest.approx(percent, abs=0.6)


def test_the_worst_pattern_reaches_the_stuffing_bound_and_no_random_frame_passes_it() -> None:
    worst = [0] * 5 + ([1] * 4 + [0] * 4) * 12  # every stuff bit begins the next run of five
    for size in range(9):
        region = 34 + 8 * size
        bound = classic_bits(size) - region - 13
        assert stuffed(worst[:region]) == bound
        rng = random.Random(size)
        assert max(stuffed([rng.getrandbits(1) for _ in range(region)]) for _ in range(200)) <= bound


def test_fd_payloads_are_rounded_up_to_a_length_that_exists() -> None:
    assert fd_bits(9) == fd_bits(12) != fd_bits(8)
    assert fd_bits(33) == fd_bits(48)
    with pytest.raises(ValueError, match="65 bytes"):
        fd_bits(65)
