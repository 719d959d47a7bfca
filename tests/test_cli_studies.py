"""The commands ``study`` and ``tune``: what they print, write and refuse."""

import signal
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import nmss_lab as lab
from nmss_lab import files
from nmss_lab.cli import main
from nmss_lab.tuning import evaluate

CORNERS = ["study", "ifac93_6_3_3", "--uncertainty", "corners2"]
MARGINAL = ["study", "marginally_stable_6_3_2", "--structure", "wang_young"]
TUNE = ["tune", "ifac93_6_3_3", "--structure", "wang_young"]


def cells(text: str, start: str) -> list[str]:
    """Return the words after the beginning of a printed line."""
    (found,) = [row for row in text.splitlines() if row.startswith(start)]
    return found.removeprefix(start).split()


# --- study -------------------------------------------------------------------------


def test_the_32_corners(capsys: pytest.CaptureFixture[str]) -> None:
    """All corners without asking for a number; two of them unstable, figure 6.6."""
    assert main([*CORNERS, "--structure", "wang_young"]) == 0
    said = capsys.readouterr()
    assert "corners of stress level 2" in said.out
    assert "32 of 32 realisations, seed 0" in said.out
    assert cells(said.out, "unstable")[:3] == ["2", "6.2", "%"]
    assert cells(said.out, "unstable")[-1] == "radius"
    assert cells(said.out, "diverges")[-3:] == ["-", "-", "radius"]
    assert cells(said.out, "leaves allowed")[0] == "6"  # between samples, 60 s
    assert "32 of 32" in said.err  # progress


def test_rates_are_those_of_the_library(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The printed count is of the table that is written, which is the library's."""
    file = tmp_path / "study.csv"
    assert main([*MARGINAL, "-n", "120", "--seed", "4", "--csv", str(file)]) == 0
    said = capsys.readouterr()
    assert said.err.splitlines() == ["100 of 120", "120 of 120"]
    case = lab.case("marginally_stable_6_3_2")
    wanted = lab.monte_carlo(
        {"wang_young": case.designs["wang_young"]},
        lab.ParameterCovariance(case.model, case.covariance),
        case.scenario,
        120,
        seed=4,
    )
    written = pd.read_csv(file)
    assert list(written.columns) == list(wanted.table.columns)
    # 17 digits are written, so what is read is the number itself
    assert written["radius"].tolist() == wanted.table["radius"].tolist()
    count = (wanted.table["radius"] >= 1.0 + 1e-6).sum()
    assert cells(said.out, "unstable")[0] == str(count)
    assert f"written: {file}" in said.out


def test_several_structures(capsys: pytest.CaptureFixture[str]) -> None:
    """A block of rates for each, in the order asked for."""
    names = ["forward_path", "wang_young"]
    assert main([*CORNERS, "--structure", *names]) == 0
    text = capsys.readouterr().out
    assert 0 < text.index("\nforward_path") < text.index("\nwang_young")


def test_ranges(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Per cent of the coefficients; what is not given has the range of 6.3.2."""
    file = tmp_path / "study.csv"
    command = [*MARGINAL, "--uncertainty", "ranges", "--b", "1", "-n", "40"]
    assert main([*command, "--csv", str(file)]) == 0
    assert "coefficients within 5 % in a and 1 % in b" in capsys.readouterr().out
    table = pd.read_csv(file)
    model = lab.case("marginally_stable_6_3_2").model
    for name, value, share in (
        ("a1", model.a[0, 0, 0], 0.05),
        ("b2", model.b[1, 0, 0], 0.01),
    ):
        off = (table[name] / value - 1.0).abs().max()
        assert 0.8 * share < off <= share  # 40 draws all below 0.8: 1e-4


def test_stress_levels_are_draws(capsys: pytest.CaptureFixture[str]) -> None:
    """Draws within a level, as many as asked for."""
    command = ["study", "ifac93_6_3_3", "--structure", "forward_path", "-n", "3"]
    assert main([*command, "--uncertainty", "stress1"]) == 0
    text = capsys.readouterr().out
    assert "draws of stress level 1" in text
    assert "3 of 3 realisations" in text


def test_two_workers_say_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    """Where it is computed shows nowhere."""
    texts = []
    for workers in ("1", "2"):
        assert main([*MARGINAL, "-n", "150", "--workers", workers]) == 0
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], 'case "nowhere": expected one of'),
        (["ifac93_6_3_3", "--structure", "pip"], 'structure "pip": this case has'),
        (["ifac93_6_3_3", "--uncertainty", "covariance"], "states no covariance"),
        (["governor_3_4", "--uncertainty", "stress1"], "those of the IFAC'93 plant"),
        (["ifac93_6_3_3", "--uncertainty", "stress1", "--a", "3"], "--a belongs to"),
        (["bilinear_8_5_1"], "monte_carlo takes a Sampler"),
        (["ifac93_6_3_3", "-n", "0"], "n = 0: expected a whole number"),
        (["ifac93_6_3_3", "--workers", "0"], "workers = 0: expected at least 1"),
        (["ifac93_6_3_3", "--cluster", "tcp://127.0.0.1:1"], "no scheduler answers"),
        (["ifac93_6_3_3", "--csv", "no/where.csv"], "there is no such folder"),
    ],
)
def test_study_says_what_is_wrong(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    """Mistakes end with exit code 1 and one sentence, before any work."""
    assert main(["study", *arguments]) == 1
    said = capsys.readouterr()
    assert message in said.err
    assert said.out == ""


def interrupted(arguments: list[str]) -> tuple[int, str, str]:
    """Run a command, press Ctrl-C after its first progress, return how it ended."""
    with subprocess.Popen(
        [sys.executable, "-m", "nmss_lab.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # its own, as if it had a terminal to itself
    ) as process:
        first = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        try:
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
    return process.returncode, out, first + err


@pytest.mark.parametrize("workers", ["1", "2"])
def test_ctrl_c_prints_what_there_is(workers: str) -> None:
    """Rates of the finished part of a study, exit code 130, and no traceback."""
    code, out, err = interrupted([*MARGINAL, "-n", "100000", "--workers", workers])
    assert code == 130, err
    (done,) = [row for row in out.splitlines() if "realisations, seed" in row]
    count, rest = done.split(" of ", 1)
    assert 100 <= int(count.replace(",", "")) < 100_000
    assert rest == "100,000 realisations, seed 0"
    assert cells(out, "unstable")
    assert "Traceback" not in err


# --- tune --------------------------------------------------------------------------


def test_goals_before_and_after(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """What is printed is what the design that is written attains."""
    file = tmp_path / "design.json"
    goals = ["--goal", "overshoot<=0.05", "--goal", "IAE <= 26"]
    command = [*TUNE, *goals, "--evaluations", "40", "--starts", "1"]
    assert main([*command, "--design", str(file)]) == 0
    text = capsys.readouterr().out
    design = files.load(file)
    case = lab.case("ifac93_6_3_3")
    assert (design.structure, design.horizon) == ("wang_young", lab.Horizon(50, 10))
    found = evaluate(
        design,
        [lab.Goal("overshoot", 0.05), lab.Goal("IAE", 26.0)],
        [lab.Trial(case.plant, case.scenario)],
    )
    for name, target, value in zip(
        ("overshoot y1", "IAE y1"), (0.05, 26.0), found, strict=True
    ):
        stated, before, after, missed = map(float, cells(text, name))
        assert stated == target
        assert after == pytest.approx(value, rel=1e-3)  # four digits are printed
        assert missed == pytest.approx(value - target, rel=1e-3)
        assert before > 0.0
    factor = max((found[0] - 0.05) / 0.05, (found[1] - 26.0) / 26.0)
    assert float(cells(text, "attainment factor")[0].rstrip(":")) == pytest.approx(
        factor, rel=1e-3
    )
    assert "weight_y" in text
    assert "weight_u" in text
    assert "40 designs tried. The search has tried 40 designs, as allowed." in text


def test_default_goals(capsys: pytest.CaptureFixture[str]) -> None:
    """At most 5 % overshoot, the rise as it was, four fifths of the error."""
    assert main([*TUNE, "--evaluations", "3"]) == 0
    text = capsys.readouterr().out
    assert cells(text, "overshoot y1")[0] == "0.05"
    target, before, *_ = map(float, cells(text, "rise y1"))
    assert target == before
    target, before, *_ = map(float, cells(text, "IAE y1"))
    assert target == pytest.approx(0.8 * before, rel=1e-3)


def test_hard_goals_and_outputs(capsys: pytest.CaptureFixture[str]) -> None:
    """A star makes a goal hard; a number or a name after @ chooses the output."""
    case = lab.case("shell_5_3_2")
    first, second, *_ = case.model.y_names
    names = [
        n for n, design in case.designs.items() if design.structure == "wang_young"
    ]
    command = ["tune", "shell_5_3_2", "--structure", names[0], "--evaluations", "4"]
    for goal in ("IAE<=60@2", f"IAE<=90@{first}", "violations<=0*"):
        command += ["--goal", goal]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert cells(text, f"IAE {second}")[0] == "60"
    assert cells(text, f"IAE {first}")[0] == "90"
    assert cells(text, f"violations {first}")[-1] == "hard"


def test_weights_at_each_step(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """With --per-step Q and R of the design are written step by step."""
    file = tmp_path / "design.json"
    command = [*TUNE, "--per-step", "--evaluations", "3", "--goal", "IAE<=20"]
    assert (
        main([*command, "--structure", "feedback_optimised", "--design", str(file)])
        == 0
    )
    assert "weight_u[5]" in capsys.readouterr().out
    files.load(file).build()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], 'case "nowhere": expected one of'),
        (["governor_3_4", "--structure", "governor"], "has no weights to tune"),
        (["ifac93_6_3_3", "--goal", "beauty<=1"], 'objective "beauty"'),
        (["ifac93_6_3_3", "--goal", "IAE<=1@4"], 'output "4": this case has y1'),
        (["ifac93_6_3_3", "--goal", "IAE<=1*"], "no soft goal"),
        (["ifac93_6_3_3", "--starts", "0"], "starts = 0"),
        (["ifac93_6_3_3", "--evaluations", "0"], "evaluations = 0"),
        (["ifac93_6_3_3", "--design", "no/where.json"], "there is no such folder"),
    ],
)
def test_tune_says_what_is_wrong(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    """Mistakes end with exit code 1 and one sentence."""
    assert main(["tune", *arguments]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("wish", ["IAE", "IAE>=3", "IAE<=x", "IAE<=3@1@2", "<=3"])
def test_wishes_that_cannot_be_read(
    capsys: pytest.CaptureFixture[str], wish: str
) -> None:
    """Argparse shows what a goal looks like."""
    with pytest.raises(SystemExit, match="2"):
        main([*TUNE, "--goal", wish])
    assert "expected a wish such as 'overshoot<=0.05'" in capsys.readouterr().err


def test_ctrl_c_keeps_the_best_design(tmp_path: Path) -> None:
    """The search ends, prints what it has, and writes it."""
    file = tmp_path / "design.json"
    goals = ["--goal", "overshoot<=0.001", "--goal", "IAE<=1"]
    budget = ["--evaluations", "100000", "--starts", "200"]
    code, out, err = interrupted([*TUNE, *goals, *budget, "--design", str(file)])
    assert code == 130, err
    assert "Stopped by Ctrl-C." in out
    assert "attainment factor" in out
    assert "Traceback" not in err
    files.load(file).build()
