"""Nothing that was committed is lost, whoever dies and whatever fills up (`python -m tools.crash` for 200 of these)."""

import os

import pytest

from tools import crash


def test_kills_of_servo_recorder_and_both_lose_no_committed_message():
    done = crash.campaign(3, seed=int.from_bytes(os.urandom(2), "little"), say=print)
    assert [one.problem for one in done] == [""] * 3
    assert {one.victim for one in done} == {"servo", "recorder", "both"}
    assert all(one.logged >= one.committed > 0 for one in done)


def test_a_full_disk_leaves_a_whole_file_a_running_arm_and_refuses_arming():
    if why := crash.no_small_disk():  # what the recorder does then is tested with a file size limit, too
        assert os.environ.get("CI") != "true", why
        pytest.skip(why)
    found = crash.fill_small_disk()
    assert found["went_on"]
    assert found["tick_after"] >= found["tick_when_full"] + 500
    assert "log_degraded" in found["arming"]
    assert found["state"] == "IDLE"
    assert found["complete"]
    assert found["open"] == []
    assert found["reason"].startswith("disk")
    assert found["lost"] > 0
    assert found["ticks"] == list(range(1, len(found["ticks"]) + 1))  # up to there without a hole
    assert 1 << 20 < found["bytes"] <= crash.DISK
