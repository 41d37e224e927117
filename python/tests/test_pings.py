"""Pings of the package against the files of `echotank replay`, bit for bit."""

import json
import operator
import threading
from pathlib import Path
from typing import Any, Callable, Dict

import numpy as np
import pytest

import echotank
from conftest import CONFIGS, FLAT, SHORT

#: Shipped rigs, shortened so that fifty pings take seconds: lines and a fan in swell, soundings, shadows with error checks.
RIGS = {
    "quickstart.toml": {"sonar.ping.range_m": 40.0, "sonar.limits.range_m": "[10.0, 40.0]"},
    "surveyor240.toml": {},
    "seabed.toml": {"sonar.ping.range_m": 40.0},
}


def overrides_of(changes: Dict[str, Any]) -> Dict[str, Any]:
    return {key: json.loads(value) if isinstance(value, str) else value for key, value in changes.items()}


@pytest.mark.parametrize("name", RIGS)
def test_fifty_pings_of_a_shipped_rig_have_the_bits_of_replay(name: str, replay: Callable[..., Path]) -> None:
    changes = RIGS[name]
    out = replay(CONFIGS / name, "1..50", "npz", changes)
    rig = echotank.Rig(CONFIGS / name, overrides_of(changes))
    assert len(rig.sonars) == 1
    with np.load(out / "pings.npz") as file:
        want = {key: file[key] for key in file.files}
    truths = [json.loads(line) for line in (out / "truth.jsonl").read_text().splitlines()]
    pings = rig.pings(1, 50)
    assert operator.length_hint(pings) == 50
    count = 0
    for p, ping in enumerate(pings):
        count += 1
        same(ping, want, p)
        assert ping.truth == truths[p]
    assert count == len(want["ping_number"]) == 50
    assert want["iq_by_element"].any()


def same(ping: echotank.Ping, want: Dict[str, np.ndarray], p: int) -> None:
    """Every array of a ping has the bytes of its row in `pings.npz`."""

    def equal(got: np.ndarray, name: str, of: Any = slice(None)) -> None:
        row = want[name][p][of]
        assert got.dtype == row.dtype and got.shape == row.shape, name
        assert got.tobytes() == np.ascontiguousarray(row).tobytes(), (name, ping.number)

    assert ping.number == want["ping_number"][p] and ping.utc_ns == want["ping_utc_ns"][p]
    equal(np.concatenate(list(ping.elements.values())), "iq_by_element")
    equal(np.concatenate(list(ping.element_position_m.values())), "element_position_m")
    equal(ping.beams, "beams")
    for k, side in enumerate(want["line_side"]):
        equal(ping.lines["port" if side < 0 else "starboard"], "lines", k)
    equal(np.array(ping.pose.position_m), "position_m")
    equal(np.array(ping.pose.velocity_m_per_s), "velocity_m_per_s")
    equal(np.array([ping.pose.roll_deg, ping.pose.pitch_deg, ping.pose.heading_deg]), "attitude_deg")
    equal(np.array([ping.pose.latitude_deg, ping.pose.longitude_deg]), "geodetic_deg")
    equal(next(iter(ping.transmit_position_m.values())), "transmit_position_m")
    angles = np.broadcast_to(want["beam_angle_rad"], (p + 1, len(ping.beam_angle_rad)))[p]
    assert ping.beam_angle_rad.tobytes() == np.ascontiguousarray(angles).tobytes()
    for name in ("sample_rate_hz", "first_sample_s", "center_frequency_hz", "sound_speed_m_per_s"):
        assert getattr(ping, name) == want[name]
    if "sounding_method" in want:
        beams = np.flatnonzero(want["sounding_method"][p])
        assert list(ping.soundings.beam) == list(beams)
        equal(ping.soundings.twtt_s, "sounding_twtt_s", beams)
        equal(ping.soundings.error_s, "sounding_error_s", beams)
        equal(ping.soundings.method, "sounding_method", beams)
    else:
        assert len(ping.soundings) == 0
    if p == 0:
        assert ping.plan == json.loads(str(want["plan"]))


def test_a_range_in_the_middle_has_the_bits_of_the_same_range_of_replay(replay: Callable[..., Path]) -> None:
    out = replay(FLAT, "7..9", "npz", SHORT)
    pings = list(echotank.Rig(FLAT, SHORT).pings(7, 3))
    assert [ping.number for ping in pings] == [7, 8, 9]
    with np.load(out / "pings.npz") as file:
        for p, ping in enumerate(pings):
            same(ping, dict(file), p)


def test_double_precision_has_the_bits_of_f64(replay: Callable[..., Path]) -> None:
    out = replay(FLAT, "1..2", "npz", SHORT, "--f64")
    with np.load(out / "pings.npz") as file:
        for p, ping in enumerate(echotank.Rig(FLAT, SHORT).pings(1, 2, double=True)):
            got = np.concatenate(list(ping.elements.values()))
            assert got.dtype == np.complex128
            assert got.tobytes() == file["iq_by_element"][p].tobytes()


def test_masks_are_those_of_replay_and_have_to_be_asked_for(replay: Callable[..., Path], tmp_path: Path) -> None:
    targets = tmp_path / "targets.toml"
    box = "size_m = [3.0, 2.0, 2.0]"
    targets.write_text(f'[[target]]\nname = "box"\nshape = "box"\nnorth_m = 0.5\neast_m = 8.0\n{box}\nlambert_db = -8.0\n')
    changes = {**SHORT, "scene.targets": str(targets)}
    out = replay(FLAT, "1..4", "masks", changes)
    seen = shadowed = 0
    with np.load(out / "masks.npz") as lines, np.load(out / "fan_masks.npz") as beams:
        for p, ping in enumerate(echotank.Rig(FLAT, changes).pings(1, 4, elements=False, masks=True)):
            for k, side in enumerate(("port", "starboard")):
                for name in ("target", "shadow", "depth_m"):
                    assert getattr(ping.masks[side], name).tobytes() == lines[name][p, k].tobytes(), (side, name)
            for name in ("target", "shadow", "depth_m"):
                got = getattr(ping.beam_mask, name)
                assert got.shape == ping.beams.shape
                assert got.tobytes() == beams[name][p].tobytes(), name
            seen += int((ping.masks["starboard"].target == 1).sum())
            shadowed += int(ping.masks["starboard"].shadow.sum())
    assert seen > 0 and shadowed > 0
    ping = next(echotank.Rig(FLAT, SHORT).pings(1, 1))
    with pytest.raises(echotank.RefusedError, match="masks=True"):
        ping.masks


def test_the_samples_do_not_depend_on_the_number_of_threads() -> None:
    rig = echotank.Rig(FLAT, SHORT)
    for one, two in zip(rig.pings(1, 3, threads=1), rig.pings(1, 3, threads=2)):
        assert one.elements["fan"].tobytes() == two.elements["fan"].tobytes()
        assert one.beams.tobytes() == two.beams.tobytes()


def test_arrays_are_handed_over_without_a_copy_and_stay_as_they_are() -> None:
    pings = echotank.Rig(FLAT, SHORT).pings(1, 3)
    first = next(pings)
    samples = first.elements["fan"]
    assert samples is first.elements["fan"] and first.elements is first.elements
    # The memory belongs to the native ping, not to NumPy.
    assert not samples.flags.owndata and samples.base is not None
    kept = samples.copy()
    del first
    second = next(pings).elements["fan"]
    assert np.array_equal(samples, kept)
    assert not np.array_equal(samples, second)


def test_the_interpreter_lock_is_released_while_a_ping_is_computed() -> None:
    # A slow ping: the reference solution of forty points.
    pings = echotank.Rig(CONFIGS / "points.toml").pings(1, 1, threads=1)
    done = threading.Event()
    count = 0

    def compute() -> None:
        next(pings)
        done.set()

    thread = threading.Thread(target=compute)
    thread.start()
    while not done.wait(0.001):
        count += 1
    thread.join()
    # With the lock held, the loop could not have run once within the ping.
    assert count > 5


def test_without_a_count_the_pings_end_with_the_navigation(tmp_path: Path) -> None:
    track = tmp_path / "track.csv"
    source = FLAT.with_name("track.csv").read_text().splitlines()
    track.write_text("\n".join(source[:12]) + "\n")
    pings = echotank.Rig(FLAT, SHORT, nav=track).pings()
    numbers = [ping.number for ping in pings]
    # Ten intervals of a second at five pings a second.
    assert 40 <= len(numbers) <= 51 and numbers == list(range(1, len(numbers) + 1))
    assert pings.skipped == 0
    with pytest.raises(StopIteration):
        next(pings)
