"""Errors are exceptions with the words of `echotank check`; nothing panics."""

from pathlib import Path
from typing import Any, Callable

import numpy as np
import pytest

import echotank
from conftest import CONFIGS, FLAT, SHORT


def test_a_wrong_configuration_raises_every_problem_as_check_prints_it(
    echotank_command: Callable[..., Any], tmp_path: Path
) -> None:
    file = tmp_path / "rig.toml"
    text = FLAT.read_text().replace("range_m = 40.0", "range_m = -40.0").replace('bottom = "sand"', 'bottom = "sandy"')
    file.write_text(text.replace('path = "track.csv"', 'path = "no.csv"'))
    with pytest.raises(echotank.ConfigurationError) as wrong:
        echotank.Rig(file)
    said = echotank_command("check", file, check=False)
    assert said.returncode == 2
    assert str(wrong.value) == said.stderr.strip()
    problems = wrong.value.problems
    assert len(problems) >= 3 and isinstance(wrong.value, (echotank.EchotankError, ValueError))
    assert str(wrong.value).splitlines()[1:] == [str(problem) for problem in problems]
    of_range = next(p for p in problems if p.path.endswith("ping.range_m"))
    assert of_range.value == "-40.0" and of_range.line == 1 + text.splitlines().index("range_m = -40.0")
    assert next(p for p in problems if "bottom" in p.path).hint


def test_a_wrong_override_is_named_without_a_line() -> None:
    with pytest.raises(echotank.ConfigurationError, match="with overrides") as wrong:
        echotank.Rig(FLAT, {"sonar.ping.range_m": -1, "sonar.0.serial": "x"})
    assert {p.path for p in wrong.value.problems} == {"sonar[0].ping.range_m", "sonar[0].serial"}
    assert all(p.line is None for p in wrong.value.problems)
    with pytest.raises(echotank.ConfigurationError, match="override sonar.7.serial=1: sonar has 1 entries"):
        echotank.Rig(FLAT, {"sonar.7.serial": 1})
    with pytest.raises(TypeError, match="object is no value of a configuration"):
        echotank.Rig(FLAT, {"sonar.0.serial": object()})


def test_overrides_take_the_types_of_python_and_numpy(tmp_path: Path) -> None:
    rig = echotank.Rig(
        FLAT,
        {
            "sonar.ping.range_m": np.float32(20),
            "scene.seed": np.int64(7),
            "sonar.model.error_check": False,
            "sonar.name": "a-name",
            "sonar.limits.range_m": (10.0, 60),
            "medium.absorption": {"db_per_km": 10.0},
        },
    )
    assert rig.sonars == ["a-name"]
    ping = next(rig.pings(1, 1))
    assert ping.sonar == "a-name" and ping.settings.range_m == 20.0


@pytest.mark.parametrize("text", ["", "[[sonar]", "\x00", "nav = 3\n", "[sonar]\nname = 1\n"])
def test_any_text_is_refused_without_a_panic(text: str, tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(text)
    with pytest.raises(echotank.ConfigurationError):
        echotank.Rig(file)
    with pytest.raises(echotank.ConfigurationError):
        echotank.Rig(file, {"scene.seed": 1})


def test_files_that_are_missing_are_configuration_errors(tmp_path: Path) -> None:
    with pytest.raises(echotank.ConfigurationError, match="cannot be read: not found"):
        echotank.Rig(tmp_path / "no.toml")
    with pytest.raises(echotank.ConfigurationError, match="no.toml: not found"):
        echotank.Rig(tmp_path / "no.toml", {"scene.seed": 1})
    with pytest.raises(echotank.ConfigurationError, match="no.csv: not found"):
        echotank.Rig(FLAT, nav=tmp_path / "no.csv")
    (tmp_path / "odd.csv").write_text("no navigation\n")
    with pytest.raises(echotank.ConfigurationError):
        echotank.Rig(FLAT, nav=tmp_path / "odd.csv").pings(1, 1)


@pytest.mark.parametrize(
    ("first", "count", "words"),
    [
        (0, 1, "first = 0: must be at least 1: pings are numbered from 1"),
        (-3, 1, "first = -3: must be a ping number"),
        (1, 0, "count = 0: must be at least 1"),
        (100_000, 1, "first = 100000: the navigation holds only about"),
    ],
)
def test_pings_that_do_not_exist_are_refused(first: int, count: int, words: str) -> None:
    with pytest.raises(echotank.RefusedError) as refused:
        echotank.Rig(FLAT, SHORT).pings(first, count)
    assert str(refused.value).startswith(words)


def test_check_reports_the_findings_of_check(echotank_command: Callable[..., Any]) -> None:
    mirrored = {"sonar.receiver.full_scale_v": 1e-9, "sonar.receiver.adc_bits": 16}
    findings = echotank.Rig(FLAT, {**SHORT, **mirrored}).check()
    said = echotank_command(
        "check", FLAT, "--set", "sonar.ping.range_m=20.0", *[x for k, v in mirrored.items() for x in ("--set", f"{k}={v}")],
        check=False,
    )  # fmt: skip
    assert findings and said.returncode == 1
    for finding in findings:
        assert f"{finding.kind}: {finding.text}" in said.stdout
        assert finding.remedy in said.stdout


def test_the_summary_is_that_of_check(echotank_command: Callable[..., Any]) -> None:
    said = echotank_command("check", CONFIGS / "points.toml", "--quick", check=False)
    summary = echotank.Rig(CONFIGS / "points.toml").summary()
    assert summary and summary.splitlines()[0] in said.stdout
