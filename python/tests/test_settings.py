"""Settings and faults that change between pings."""

import numpy as np
import pytest

import echotank
from conftest import FLAT, SHORT

#: The plain sum of few scatterers: neither methods nor culling follow from the settings at the start.
DIRECT = {
    **SHORT,
    "scene.seabed.density_per_m2": 1.0,
    "sonar.model.path": "polyline",
    "sonar.model.doppler": "stretch",
    "sonar.model.synthesis": "direct",
}


def test_a_changed_range_holds_from_the_next_ping_on() -> None:
    pings = echotank.Rig(FLAT, DIRECT).pings(1, 4)
    first = next(pings)
    pings.set(range_m=30.0, source_level_db=200.0)
    assert pings.settings().range_m == 30.0
    second = next(pings)
    assert (first.settings.range_m, second.settings.range_m) == (20.0, 30.0)
    assert second.elements["fan"].shape[1] > first.elements["fan"].shape[1]
    # The settings of a rig that always had them give the same samples.
    other = echotank.Rig(FLAT, {**DIRECT, "sonar.ping.range_m": 30.0, "sonar.ping.source_level_db": 200.0}).pings(1, 4)
    next(other)
    assert next(other).elements["fan"].tobytes() == second.elements["fan"].tobytes()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"range_m": 5.0}, "range_m = 5: must be from 10 to 60"),
        ({"range_m": float("nan")}, "range_m = NaN: must be a finite number"),
        ({"source_level_db": 300.0, "range_m": 30.0}, "source_level_db = 300: must be from 120 to 215"),
        ({"max_ping_rate_hz": 0.0}, "max_ping_rate_hz = 0: must be from 5 to 5"),
    ],
)
def test_a_refused_setting_names_key_value_and_rule_and_changes_nothing(settings: dict, words: str) -> None:
    pings = echotank.Rig(FLAT, SHORT).pings(1, 1)
    with pytest.raises(echotank.RefusedError) as refused:
        pings.set(**settings)
    assert str(refused.value) == words
    assert pings.settings().range_m == 20.0
    with pytest.raises(echotank.RefusedError, match="must be one of demo"):
        pings.set("other", range_m=30.0)


def test_a_fault_holds_from_the_next_ping_until_it_is_cleared() -> None:
    pings = echotank.Rig(FLAT, SHORT).pings(1, 3)
    assert next(pings).elements["fan"][3].any()
    number = pings.inject("dead", array=2, element=3)
    ping = next(pings)
    assert not ping.elements["fan"][3].any()
    assert ping.elements["fan"][4].any()
    injections = pings.take_injections()
    assert [(i["fault"], i["kind"], i["ping_number"], i["element"]) for i in injections] == [(number, "dead", 2, 3)]
    assert pings.take_injections() == []
    assert pings.clear_faults(number) == 1 and pings.clear_faults() == 0
    assert next(pings).elements["fan"][3].any()


@pytest.mark.parametrize(
    ("kind", "keys", "words"),
    [
        ("dead", {"element": 900}, "there is no such element"),
        ("deaf", {}, 'did you mean "dead"'),
        ("dead", {"elements": 1}, "unknown field `elements`"),
        ("dead", {"sonar": "other"}, "sonar"),
    ],
)
def test_a_fault_that_does_not_fit_is_refused_with_the_reason(kind: str, keys: dict, words: str) -> None:
    pings = echotank.Rig(FLAT, SHORT).pings(1, 1)
    with pytest.raises(echotank.RefusedError) as refused:
        pings.inject(kind, **keys)
    assert words in str(refused.value)


def test_a_fault_of_the_configuration_applies_as_well() -> None:
    rig = echotank.Rig(FLAT, {**SHORT, "fault": [{"kind": "dead", "array": 2, "element": 0}]})
    ping = next(rig.pings(1, 1))
    assert not ping.elements["fan"][0].any() and np.abs(ping.elements["fan"][1]).max() > 0
