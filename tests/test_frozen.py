"""Every shipped scenario and world does what it did: to the bit where the processor is the one it was frozen on."""

import json

import pytest

from tools import digests
from tools.golden import cpu

FROZEN = json.loads(digests.FILE.read_text(encoding="utf-8"))


def test_every_shipped_scenario_is_frozen_with_a_reason():
    assert set(FROZEN) == set(digests.scenarios())
    assert all(entry["reason"] for entry in FROZEN.values())


@pytest.mark.parametrize("name", sorted(FROZEN))
def test_it_does_what_it_did(name):
    now = digests.played(digests.scenarios()[name])
    assert not digests.differences(FROZEN[name], now, FROZEN[name]["cpu"] == cpu())


def test_a_changed_command_is_noticed():
    known = FROZEN["trap"]
    assert digests.differences(known, {**known, "digest": "0"}, same_cpu=True)
    nearer = {**known["figures"], "min_clearance_m": known["figures"]["min_clearance_m"] - 0.001}
    assert digests.differences(known, {**known, "digest": "0", "figures": nearer}, same_cpu=False)
