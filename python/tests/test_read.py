"""Recordings of a replay, read again, against the pings that they hold."""

import shutil
from pathlib import Path
from typing import Callable, List

import numpy as np
import pytest

import echotank
from conftest import FLAT, SHORT

#: With a full scale that suits the samples, so that integers keep their detail.
RIG = {**SHORT, "sonar.receiver.full_scale_v": 5.0}
COUNT_V = 5.0 / 32767
FORMATS = "npz,zarr,s7k,jsf,xtf,sigmf,wav,masks"


@pytest.fixture(scope="module")
def folder(replay: Callable[..., Path]) -> Path:
    return replay(FLAT, "1..3", FORMATS, RIG)


@pytest.fixture(scope="module")
def pings() -> List[echotank.Ping]:
    return list(echotank.Rig(FLAT, RIG).pings(1, 3, masks=True))


def close(got: np.ndarray, want: np.ndarray, step: float) -> None:
    assert got.shape == want.shape
    assert np.abs(got - want).max() <= step


def test_npz_holds_the_pings_bit_for_bit(folder: Path, pings: List[echotank.Ping]) -> None:
    assert_equal_bits(echotank.read(folder / "pings.npz"), pings)


def test_zarr_holds_the_pings_and_their_masks_bit_for_bit(folder: Path, pings: List[echotank.Ping]) -> None:
    recording = echotank.read(folder / "pings.zarr")
    assert_equal_bits(recording, pings, "zarr")
    for got, want in zip(recording, pings):
        assert got.soundings.level_v.tobytes() == want.soundings.level_v.tobytes()
        assert got.masks.keys() == {*want.masks, "beams"}
        for side, mask in {**want.masks, "beams": want.beam_mask}.items():
            assert np.array_equal(got.masks[side].target, mask.target)
            assert np.array_equal(got.masks[side].shadow, mask.shadow)
            assert np.array_equal(got.masks[side].depth_m, mask.depth_m, equal_nan=True)


def test_an_incomplete_zarr_names_what_is_missing(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(echotank.RecordingError, match="is a folder without zarr.json"):
        echotank.read(tmp_path)
    store = shutil.copytree(folder / "pings.zarr", tmp_path / "pings.zarr")
    (store / "beams" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(echotank.RecordingError, match="beams/c/1/0/0 is missing"):
        echotank.read(store)


def assert_equal_bits(recording: echotank.Recording, pings: List[echotank.Ping], form: str = "npz") -> None:
    assert (recording.format, recording.unit, len(recording)) == (form, "V", 3)
    for got, want in zip(recording, pings):
        assert (got.number, got.utc_ns) == (want.number, want.utc_ns)
        assert got.elements.keys() == want.elements.keys()
        for name, samples in want.elements.items():
            assert got.elements[name].tobytes() == samples.tobytes()
        assert got.beams.tobytes() == want.beams.tobytes()
        assert got.lines.keys() == want.lines.keys()
        assert all(got.lines[side].tobytes() == line.tobytes() for side, line in want.lines.items())
        assert got.soundings is not None
        assert got.soundings.twtt_s.tobytes() == want.soundings.twtt_s.tobytes()


def test_s7k_holds_samples_lines_beams_and_soundings_in_counts(folder: Path, pings: List[echotank.Ping]) -> None:
    recording = echotank.read(folder / "demo.s7k")
    assert (recording.format, recording.unit, len(recording)) == ("s7k", "counts", 3)
    for got, want in zip(recording, pings):
        assert got.number == want.number and abs(got.utc_ns - want.utc_ns) < 2_000
        samples = np.concatenate(list(want.elements.values()))
        close(got.elements["receive"] * COUNT_V, samples, 0.75 * COUNT_V)
        assert got.first_sample_s == pytest.approx(want.first_sample_s, abs=0.5 / want.sample_rate_hz)
        # The levels have a scale of their own; their shape is that of the lines and beams.
        for side, line in want.lines.items():
            assert np.corrcoef(got.lines[side][: len(line)], line)[0, 1] > 0.9999
        beams = got.beams[:, -want.beams.shape[1] :]
        share = np.vdot(beams, want.beams) / np.linalg.norm(beams) / np.linalg.norm(want.beams)
        assert share.real > 0.9999
        np.testing.assert_allclose(got.beam_angle_rad, want.beam_angle_rad, atol=1e-6)
        assert list(got.soundings.beam) == list(want.soundings.beam) and len(want.soundings) > 20
        np.testing.assert_allclose(got.soundings.twtt_s, want.soundings.twtt_s, rtol=1e-6)
        np.testing.assert_allclose(got.soundings.error_s, want.soundings.error_s, rtol=1e-5)
        assert list(got.soundings.method) == list(want.soundings.method)


def test_jsf_and_xtf_hold_the_lines_in_volts(folder: Path, pings: List[echotank.Ping]) -> None:
    for name, step in (("demo.jsf", 2**-14), ("demo.xtf", 2**-15)):
        recording = echotank.read(folder / name)
        assert (recording.unit, len(recording)) == ("V", 3), name
        for got, want in zip(recording, pings):
            assert got.number == want.number
            assert got.sound_speed_m_per_s == pytest.approx(1500.0)
            assert got.sample_rate_hz == pytest.approx(want.sample_rate_hz, rel=1e-3)
            assert got.lines.keys() == want.lines.keys()
            for side, line in want.lines.items():
                peak = max(line.max(), RIG["sonar.receiver.full_scale_v"])
                close(got.lines[side], line, step * peak)


def test_sigmf_holds_the_element_samples_in_volts(folder: Path, pings: List[echotank.Ping]) -> None:
    for name in ("demo.sigmf-meta", "demo.sigmf-data"):
        recording = echotank.read(folder / name)
        assert (recording.format, recording.unit, len(recording)) == ("sigmf", "V", 3)
        for got, want in zip(recording, pings):
            assert got.number == want.number and got.sample_rate_hz == want.sample_rate_hz
            samples = np.concatenate(list(want.elements.values()))
            close(got.elements["receive"], samples, 0.75 * COUNT_V)


def test_wav_holds_the_passband_of_every_element(folder: Path, pings: List[echotank.Ping]) -> None:
    recording = echotank.read(folder / "demo.wav")
    elements = sum(len(samples) for samples in pings[0].elements.values())
    assert recording.signal is not None and recording.signal.shape[0] == elements
    assert recording.unit == "full scale" and recording.signal_rate_hz > 600e3
    # Three pings at five a second.
    length_s = recording.signal.shape[1] / recording.signal_rate_hz
    assert 0.4 < length_s < 0.6
    # The rms of the real signal is that of the envelope; an envelope of full scale has an amplitude of 1.
    first_s = 20.0 * 2 / 1500
    volts = np.sqrt(2) * RIG["sonar.receiver.full_scale_v"]
    part = recording.signal[2, : int(first_s * recording.signal_rate_hz)] * volts
    want = pings[0].elements["fan"][0]
    assert np.sqrt(np.mean(part**2)) == pytest.approx(np.sqrt(np.mean(np.abs(want) ** 2)), rel=0.1)


def test_masks_and_truth_are_those_of_the_pings(folder: Path, pings: List[echotank.Ping]) -> None:
    lines, fan, truth = (echotank.read(folder / name) for name in ("masks.npz", "fan_masks.npz", "truth.jsonl"))
    for p, want in enumerate(pings):
        assert lines[p].number == fan[p].number == truth[p].number == want.number
        for side, mask in want.masks.items():
            assert np.array_equal(lines[p].masks[side].depth_m, mask.depth_m, equal_nan=True)
        assert np.array_equal(fan[p].masks["beams"].shadow, want.beam_mask.shadow)
        assert truth[p].truth == want.truth


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.npz", b"PK\x03\x04 and nothing"),
        ("a.s7k", b"\x05\x00\x3c\x00\xff\xff\x00\x00"),
        ("a.jsf", b"\x01\x16"),
        ("a.xtf", b"\x7b\x01"),
        ("a.svlog", b"BR"),
        ("a.wav", b"RIFF\x00\x00\x00\x00WAVE"),
        ("a.jsonl", b"{no"),
        ("a.sigmf-meta", b"{}"),
        ("a.txt", b"hello"),
        ("empty", b""),
    ],
)
def test_what_is_no_recording_is_refused_by_name(name: str, data: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(echotank.RecordingError) as refused:
        echotank.read(tmp_path / name)
    assert name in str(refused.value)


def test_a_recording_that_is_cut_off_gives_the_whole_pings_or_an_error(folder: Path, tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    for name in ("demo.s7k", "demo.jsf", "demo.xtf", "demo.wav", "pings.npz", "truth.jsonl"):
        data = (folder / name).read_bytes()
        for cut in random.integers(1, len(data), 8):
            (tmp_path / name).write_bytes(data[:cut])
            try:
                assert len(echotank.read(tmp_path / name)) <= 3
            except echotank.RecordingError:
                pass
