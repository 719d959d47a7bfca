"""Reports of designs: what they say, that they reproduce it, and how they look."""

import base64
import contextlib
import datetime
import html
import io
import re
import runpy
import xml.etree.ElementTree as ET
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from test_cli_studies import interrupted

import nmss_lab as lab
from nmss_lab.cases import stress
from nmss_lab.cli import main
from nmss_lab.files import Study, dumps, load, loads, save
from nmss_lab.measures import table
from nmss_lab.plots import STYLES, Chart, Curve, loop_charts
from nmss_lab.report import report
from nmss_lab.svg import svg

DAY = datetime.date(2007, 9, 30)
NASTY = "<script>alert('1')</script>"


def study(case: str = "governor_3_4", structure: str = "governor") -> Study:
    """Return a worked example as a study without a run."""
    example = lab.case(case)
    return Study(example.designs[structure], example.plant, example.scenario)


def run_of(content: Study) -> lab.Run:
    """Run a study."""
    return lab.closed_loop(content.plant, content.design.build(), content.scenario)


class Parsed(HTMLParser):
    """Texts, tables and links of a report; complains about tags that do not match."""

    VOID = ("meta", "link", "path")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list) -> None:
        """Note a tag."""
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        """Note an element of SVG without content."""
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        """Close the tag that was opened last."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Note text, in a table by row and cell."""
        self.texts.append(data)
        if {"td", "th"} & set(self.open[-1:]):
            self.rows[-1][-1] += data

    @property
    def text(self) -> str:
        """All that is to be read."""
        return " ".join(" ".join(self.texts).split())

    def row(self, start: str) -> list[str]:
        """Return the cells of the only row of that name."""
        (found,) = [row for row in self.rows if row[0] == start]
        return found[1:]


def unpack(text: str, folder: Path) -> tuple[Path, Path]:
    """Write the design file and the script that a report holds."""
    (data,) = re.findall(r'href="data:application/json;base64,([^"]+)"', text)
    (code,) = re.findall(r"<pre><code>(.*?)</code></pre>", text, re.DOTALL)
    design, script = folder / "design.json", folder / "again.py"
    design.write_bytes(base64.b64decode(data))
    script.write_text(html.unescape(code), encoding="utf-8")
    return design, script


def printed(value: float) -> str:
    """Return a number as reports and the command line show it."""
    return f"{value:.5g}"


# --- One truth ---------------------------------------------------------------------

WORDS = {
    "rise": "Rise from 10 to 90 % [s]",
    "settling": "Settling to 5 % [s]",
    "overshoot": "Overshoot [%]",
    "IAE": "Integral of the absolute error (IAE)",
    "ISE": "Integral of the squared error (ISE)",
    "RMS du": "Change of the inputs, root mean square",
    "violations": "Samples at which a limit is broken",
}


@pytest.mark.parametrize(
    ("case", "structure"),
    [
        ("governor_3_4", "governor"),
        ("ifac93_6_3_3", "forward_path"),
        ("measured_disturbance_7_4_1", "disturbance_direct"),
        ("bilinear_8_5_1", "frozen"),
    ],
)
def test_python_command_and_report_say_the_same(
    case: str,
    structure: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Every measure, to the last printed digit; the CSV file holds the same run."""
    content = study(case, structure)
    file, csv = tmp_path / "mine.json", tmp_path / "run.csv"
    save(file, content)
    run = run_of(load(file))
    (row,) = table({"mine": run})
    wanted = [printed(value) for key, value in row.items() if key != "run"]
    assert main(["simulate", str(file), "--csv", str(csv)]) == 0
    said = capsys.readouterr().out
    own = content.design.structure
    lines = [line for line in said.splitlines() if line.startswith(own)]
    name, *numbers = lines[1].split()
    assert (name, numbers) == (own, wanted)
    parsed = Parsed(report(content))
    for key, word in WORDS.items():
        shown = printed(row[key]) if np.isfinite(row[key]) else "\u2013"
        assert parsed.row(word) == [shown], key
    written = np.genfromtxt(csv, delimiter=",", skip_header=1)
    assert np.array_equal(written[:, 1 : 1 + run.y.shape[1]], run.y)


@pytest.mark.parametrize("kind", ["sampled", "continuous", "model", "alone"])
def test_script_and_file_of_a_report_reproduce_it(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the report shows comes from its own script and its own design file."""
    example = lab.case("quadruple_tank_minus")
    name, design = next(iter(example.designs.items()))
    plant = {
        "sampled": example.plant,
        "continuous": example.continuous,
        "model": design.model,
        "alone": None,
    }[kind]
    content = Study(design, plant, None if kind == "alone" else example.scenario)
    text = report(content)
    parsed = Parsed(text)
    unpack(text, tmp_path)
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        again = runpy.run_path("again.py")
    for channel, output in enumerate(("level 1", "level 2")):
        (row,) = table({name: again["run"]}, channel)
        shown = [r[1] for r in parsed.rows if r[0] == WORDS["IAE"]][channel]
        assert shown == printed(row["IAE"])
        assert repr(row["IAE"]) in out.getvalue()
        assert output in out.getvalue()
    review = lab.review(again["controller"], example.plant if kind[0] in "sc" else None)
    for finding in review.findings:
        assert f"{finding.topic}: {finding.sentence}" in parsed.text


def test_rates_of_a_report_come_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counts, intervals and sizes are those of the study that the script makes."""
    content = study("marginally_stable_6_3_2", "wang_young")
    uncertainty = lab.RelativeRanges(content.design.model, {"a": 0.05, "b": 0.15})
    text = report(content, uncertainty=uncertainty, realisations=120, seed=4)
    parsed = Parsed(text)
    assert "within 5 % in a and 15 % in b" in parsed.text
    assert "120 of 120 realisations, seed 4" in parsed.text
    unpack(text, tmp_path)
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()):
        drawn = runpy.run_path("again.py")["drawn"]
    (rates,) = drawn.rates().query("event == 'unstable'").to_dict("records")
    assert 0 < rates["count"] < 120
    assert parsed.row("unstable") == [
        f"{rates['count']} of 120: {100 * rates['share']:.1f} %",
        f"{100 * rates['low']:.1f} to {100 * rates['high']:.1f} %",
        f"{rates['median']:.4g}",
        f"{rates['worst']:.4g}",
        "largest pole",
    ]
    worst = drawn.table.loc[drawn.table["IAE"].idxmax()]
    said = [row for row in parsed.rows if row[0] == "y1" and len(row) == 5]
    assert said[0][1:4] == [
        printed(worst["IAE"]),
        str(worst["realisation"]),
        printed(worst["radius"]),
    ]
    assert said[0][4].startswith(f"a1 = {worst['a1']:.5g}, a2 = {worst['a2']:.5g}")


def test_a_covariance_is_in_the_script(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A covariance is written to the last digit."""
    example = lab.case("marginally_stable_6_3_2")
    content = study("marginally_stable_6_3_2", "wang_young")
    uncertainty = lab.ParameterCovariance(example.model, example.covariance)
    unpack(report(content, uncertainty=uncertainty, realisations=2), tmp_path)
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()):
        made = runpy.run_path("again.py")["uncertainty"]
    assert np.array_equal(made.covariance, example.covariance)


def test_all_corners_without_a_number() -> None:
    """The 32 corners of a stress level, two of them unstable (figure 6.6)."""
    content = study("ifac93_6_3_3", "wang_young")
    corners = stress(2, True, content.plant.dt, content.plant.substeps)
    parsed = Parsed(report(content, uncertainty=corners))
    assert parsed.row("unstable")[0] == "2 of 32: 6.2 %"
    assert parsed.row("zeta") == ["0.15", "0.45"]


def test_a_study_can_be_stopped() -> None:
    """A true answer of the callback ends it; the report says so."""
    content = study("marginally_stable_6_3_2", "wang_young")
    uncertainty = lab.RelativeRanges(content.design.model, {"b": 0.1})
    told: list[tuple[int, int]] = []

    def callback(done: int, asked: int) -> bool:
        told.append((done, asked))
        return True

    text = report(content, uncertainty=uncertainty, realisations=300, callback=callback)
    assert told == [(100, 300)]
    assert "100 of 300 realisations, seed 0. The study was stopped" in text


def test_same_arguments_same_text() -> None:
    """With a date, nothing else but arguments and versions decides."""
    texts = {report(study(), date=DAY) for _ in range(2)}
    assert len(texts) == 1
    assert Parsed(texts.pop()).row("Date") == ["2007-09-30"]


# --- What it says ------------------------------------------------------------------


def test_the_design_is_told() -> None:
    """Structure, horizons, weights, limits with units, model, options, scenario."""
    model = lab.DifferenceModel(
        [-0.9], [0.0, 0.125], dt=2.0, y_names=["T"], u_names=["Q"], units={"Q": "kW"}
    )
    limits = lab.Limits(u=(0.0, 8.0), y=(-np.inf, 1.5), outputs="soft", soft_weight=50)
    design = lab.Design(
        "integral_of_error",
        model,
        lab.Horizon(9, 3, (1, 2, 3)),
        (1.0, 0.0, 0.25),
        0.75,
        limits,
        "zero",
        {"terminal": "lq", "backend": "proxqp"},
    )
    reference = np.r_[np.zeros(4), np.ones(26)]
    scenario = lab.Scenario(reference, input_disturbance=-0.5 * reference[::-1])
    parsed = Parsed(report(Study(design, model, scenario), title="Heater & valve"))
    assert parsed.text.startswith("Heater & valve")
    assert parsed.row("Prediction horizon Np") == ["9 samples"]
    assert parsed.row("Moves held for") == ["1, 2, 3 samples"]
    assert parsed.row("Weight Q") == ["1, 0, 0.25"]
    assert parsed.row("terminal") == ["lq"]
    assert parsed.row("Input Q [kW]") == ["0", "8"]
    assert parsed.row("Output T") == ["none", "1.5"]
    assert "a squared unit of violation costs 50" in parsed.text
    assert ["T", "Q", "b", "0, 0.125"] in parsed.rows
    assert parsed.row("Reference") == ["T", "0; 1 from 8 s"]
    assert parsed.row("Disturbance at the input, not measured") == [
        "Q [kW]",
        "-0.5; 0 from 52 s",
    ]
    assert "reference acts through the sum of the error alone" in parsed.text
    assert parsed.row("Solver")[0].startswith("proxqp (proxsuite ")


def test_every_case_has_a_report() -> None:
    """All plants and structures, also those without poles; nothing is cut short."""
    for name in lab.CASES:
        example = lab.case(name)
        structure = list(example.designs)[-1]
        parsed = Parsed(report(study(name, structure)))
        assert "nan" not in parsed.text.split()
        figures = sum(tag == "figure" for tag, _ in parsed.tags)
        poles = example.equation is None
        assert figures == example.model.n_y + 2 * example.model.n_u + poles, name


def test_a_design_alone_says_what_was_assumed() -> None:
    """A bare design gets a plant and a scenario, and the report names them."""
    design = study().design
    parsed = Parsed(report(design))
    assert "Not stated, and assumed: The plant is the model itself." in parsed.text
    assert parsed.row("Reference")[1].startswith("0; 1 from 5 s")


def test_a_stored_run_is_checked() -> None:
    """A run in the file is made again; a difference is told."""
    content = study()
    run = run_of(content)
    same = Study(content.design, content.plant, content.scenario, run)
    assert "outputs and inputs are equal to the bit" in report(same)
    run.y[7] += 0.25
    assert "differs: outputs and inputs by up to 0.25." in report(same)


def test_other_runs_beside_it() -> None:
    """Further runs have columns and curves; the file does not hold them."""
    content, other = study(), run_of(study("governor_3_4", "pip"))
    parsed = Parsed(report(content, runs={"plain": other}))
    (row,) = table({"plain": other})
    assert parsed.row(WORDS["overshoot"])[1] == printed(row["overshoot"])
    assert "It does not hold what was shown beside it: plain." in parsed.text
    with pytest.raises(ValueError, match='"governor" is the name of the run'):
        report(content, runs={"governor": other})
    with pytest.raises(ValueError, match="4 runs: expected 1 to 3"):
        report(content, runs=dict.fromkeys("abc", other))


def test_what_cannot_be_reported_is_refused() -> None:
    """Mistakes are told, not drawn."""
    with pytest.raises(ValueError, match="study is a Record"):
        report(lab.Record(np.arange(3.0), np.zeros(3)))
    model = lab.StateDependentModel([-0.7], [lambda y, u: 1.0 + 0.0 * y[..., 0, 0]])
    with pytest.raises(ValueError, match="function, which no file can hold"):
        report(lab.Design("sdp_increments", model))


def test_all_that_is_read_is_escaped() -> None:
    """Names, units, options and titles are text, never markup."""
    model = lab.DifferenceModel(
        [-0.5], [1.0], y_names=[NASTY], u_names=['"><img src=x>'], units={NASTY: "<b>"}
    )
    content = Study(lab.Design("wang_young", model))
    example = run_of(Study(content.design, model, lab.Scenario(np.ones(65))))
    text = report(content, title=f"{NASTY} & co", runs={"</svg><script>": example})
    parsed = Parsed(text)
    assert {tag for tag, _ in parsed.tags}.isdisjoint({"script", "img"})
    assert sum(tag == "b" for tag, _ in parsed.tags) == len(
        lab.review(content.design.build()).findings
    )
    assert not any(name.startswith("on") for _, attrs in parsed.tags for name in attrs)
    assert f"{NASTY} & co" in parsed.text
    assert f"Output {NASTY} [<b>]" in parsed.text


# --- Figures as SVG ----------------------------------------------------------------

SVG = "{http://www.w3.org/2000/svg}"


def chart(*curves: Curve, **more: object) -> Chart:
    """Return a chart over ten seconds."""
    options = {"samples": np.array([0.0, 10.0]), **more}
    return Chart("test", "A title", "y [-]", curves, **options)


def paths(drawn: str, style: int = 0) -> list[str]:
    """Return the lines of a run, without those of the legend."""
    (inner,) = ET.fromstring(drawn).findall(f"{SVG}svg")
    found = inner.findall(f"{SVG}path[@class='style{style}']")
    return [path.get("d") for path in found]


def test_a_picture_is_a_file_of_its_own() -> None:
    """It is well-formed, small, and named and described for who cannot see it."""
    example = lab.case("governor_3_4")
    run = lab.closed_loop(
        example.plant, example.designs["governor"].build(), example.scenario
    )
    for each in loop_charts({"<&>": run}):
        drawn = svg(each)
        root = ET.fromstring(drawn)
        assert len(drawn) < 6000
        assert root.get("role") == "img"
        named = root.get("aria-labelledby").split()
        texts = {part.get("id"): part.text for part in root}
        assert texts[named[0]] == each.title
        assert "<&>: " in texts[named[1]]


def test_values_are_drawn_where_they_are() -> None:
    """Coordinates are those of the axes; held values go in steps, gaps stay gaps."""
    t, y = np.array([0.0, 5.0, 10.0]), np.array([0.0, 1.0, 2.0])
    held = chart(Curve("held", t, y, held=True), limits=(-np.inf, 1.0))
    drawn = svg(held)
    (inner,) = ET.fromstring(drawn).findall(f"{SVG}svg")
    width, height = float(inner.get("width")), float(inner.get("height"))
    low, high = held.vertical
    numbers = [float(x) for x in re.findall(r"-?[\d.]+", paths(drawn)[0])]
    places = [height * (high - value) / (high - low) for value in y]
    wanted = [0.0, places[0], width / 2, places[1], width, places[2]]
    assert numbers == pytest.approx(wanted, abs=0.06)  # a tenth is written
    assert re.sub(r"[\d. -]+", "", paths(drawn)[0]) == "MHVHV"
    (limit,) = [p for p in inner if p.get("stroke-dasharray") == "2 4"]
    at = float(re.match(r"M0 ([\d.]+)", limit.get("d"))[1])
    assert at == pytest.approx(places[1], abs=0.06)
    gap = Curve("gap", np.arange(5.0), np.array([0.0, 1.0, np.nan, 1.0, 0.0]))
    assert paths(svg(chart(gap)))[0].count("M") == 2


def test_level_stretches_cost_nothing() -> None:
    """A thousand equal values are two points, and the ends stay."""
    y = np.r_[np.zeros(500), np.ones(500)]
    (path,) = paths(svg(chart(Curve("step", np.linspace(0.0, 10.0, 1000), y))))
    assert len(re.findall("[ML]", path)) == 4


def test_runs_differ_by_more_than_colour() -> None:
    """Each run has its dash, in the picture and in the legend."""
    t = np.linspace(0.0, 10.0, 5)
    curves = [Curve(f"run {i}", t, i + t, style=i) for i in range(3)]
    root = ET.fromstring(svg(chart(*curves)))
    for i, style in enumerate(STYLES):
        lines = root.findall(f".//{SVG}path[@class='style{i}']")
        dash = " ".join(map(str, style["dash"])) or None
        assert [line.get("stroke-dasharray") for line in lines] == [dash] * 2


def test_a_circle_is_round() -> None:
    """In the plane of poles both axes have the same scale."""
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    ring = Curve("circle", np.cos(angle), np.sin(angle))
    drawn = svg(chart(ring, across="real part", samples=np.array([-1.1, 1.1])))
    numbers = re.findall(r"[ML]([\d.]+) ([\d.]+)", paths(drawn)[0])
    x, y = np.array(numbers, dtype=float).T
    assert np.ptp(x) == pytest.approx(np.ptp(y), abs=0.3)


@pytest.mark.parametrize(
    ("low", "high", "log", "labels"),
    [
        (0.0, 60.0, False, ["0", "20", "40", "60"]),
        (-0.3, 0.3, False, ["\u22120.4", "\u22120.2", "0", "0.2", "0.4"]),
        (1e-6, 0.1, True, ["1e\u22127", "1e\u22125", "0.001", "0.1"]),
        (99990.0, 100010.0, False, ["99990", "99995", "100000", "100005", "100010"]),
        (1.00001, 1.00002, False, ["1.00001", "1.000015", "1.00002"]),
    ],
)
def test_ticks_are_round_numbers(
    low: float, high: float, log: bool, labels: list[str]
) -> None:
    """Labels are short, and stand at round numbers."""
    y = np.geomspace(low, high, 5) if log else np.linspace(low, high, 5)
    root = ET.fromstring(svg(chart(Curve("y", np.linspace(0, 10, 5), y), log=log)))
    texts = [text.text for text in root.findall(f"{SVG}text[@text-anchor='end']")]
    assert texts == labels


# --- The command -------------------------------------------------------------------


@pytest.fixture
def design_file(tmp_path: Path) -> Path:
    """Return a file with a bare design."""
    file = tmp_path / "heater.json"
    save(file, study("marginally_stable_6_3_2", "wang_young").design)
    return file


def test_the_command_writes_a_report(
    design_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says what was assumed and written; an older report is replaced whole."""
    out = design_file.with_suffix(".html")
    out.write_text("older")
    command = ["report", str(design_file), "--realisations", "120", "--b", "1"]
    assert main([*command, "--seed", "4"]) == 0
    said = capsys.readouterr()
    assert said.err.splitlines() == ["100 of 120", "120 of 120"]
    assert "- The plant is the model itself." in said.out
    assert f"written: {out}, " in said.out
    parsed = Parsed(out.read_text(encoding="utf-8"))
    assert parsed.text.startswith("Report of heater.json")
    assert "5 % in a and 1 % in b" in parsed.text
    assert parsed.row("Seed") == ["4"]
    assert sorted(p.name for p in design_file.parent.iterdir()) == [
        "heater.html",
        "heater.json",
    ]


def test_workers_write_the_same(design_file: Path) -> None:
    """Where the plants are run shows nowhere."""
    texts = []
    for workers in ("1", "2"):
        out = design_file.parent / f"{workers}.html"
        command = ["report", str(design_file), "--uncertainty", "ranges"]
        more = ["--realisations", "150", "--workers", workers, "--out", str(out)]
        assert main([*command, *more]) == 0
        texts.append(out.read_text(encoding="utf-8"))
    assert texts[0] == texts[1]


def test_study_and_tune_take_files_as_well(
    design_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A name that ends in .json is a file for every command that runs a case."""
    assert main(["study", str(design_file), "-n", "5"]) == 0
    assert "wang_young from heater.json: coefficients" in capsys.readouterr().out
    assert main(["tune", str(design_file), "--evaluations", "3"]) == 0
    assert "wang_young from heater.json: wang_young" in capsys.readouterr().out


def test_the_command_says_what_is_wrong(
    design_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Mistakes end with exit code 1 and one sentence, and write nothing."""
    folder = design_file.parent
    broken, record = folder / "broken.json", folder / "record.json"
    broken.write_text(design_file.read_text()[:-9])
    save(record, lab.Record(np.arange(3.0), np.zeros(3)))
    unbuilt = folder / "unbuilt.json"
    save(unbuilt, lab.Design("pip", lab.DifferenceModel([-0.5], [1.0])))
    before = sorted(folder.iterdir())
    file = str(design_file)
    for arguments, message in (
        (["report", str(broken)], "broken.json: not a JSON file: "),
        (["simulate", str(broken)], "broken.json: not a JSON file: "),
        (["simulate", str(record)], "record.json holds a Record, expected a Study"),
        (["report", str(unbuilt)], "unbuilt.json: the design cannot be built: "),
        (["report", str(folder / "none.json")], "No such file"),
        (["report", file, "--out", file], "this is the design file itself"),
        (["report", file, "--out", "no/where.html"], "there is no such folder"),
        (["report", file, "--uncertainty", "covariance"], "states no covariance"),
        (["report", file, "--uncertainty", "stress1"], "those of the IFAC'93 plant"),
        (["report", file, "--realisations", "0"], "n = 0: expected a whole number"),
        (["simulate", file, "--structure", "pip"], 'structure "pip": this case has'),
    ):
        assert main(arguments) == 1, arguments
        said = capsys.readouterr()
        assert message in said.err
        assert said.out == ""
    assert sorted(folder.iterdir()) == before


def test_ctrl_c_reports_what_there_is(design_file: Path) -> None:
    """The report has the finished part of the study, and the exit code is 130."""
    out = design_file.with_suffix(".html")
    code, printed_, err = interrupted(
        ["report", str(design_file), "--realisations", "100000"]
    )
    assert code == 130, err
    assert "written: " in printed_
    assert "Traceback" not in err
    text = Parsed(out.read_text(encoding="utf-8")).text
    done, asked = re.search(r"([\d,]+) of ([\d,]+) realisations", text).groups()
    assert 100 <= int(done.replace(",", "")) < 100_000
    assert asked == "100,000"


# --- In the browser ----------------------------------------------------------------

Show = Callable[..., Page]


@pytest.fixture
def show(browser: Browser, tmp_path: Path) -> Show:
    """Yield a function that opens a report without a server; it must load nothing."""
    contexts, said = [], []

    def open_report(text: str, width: int = 1440, **more: object) -> Page:
        file = tmp_path / "report.html"
        file.write_text(text, encoding="utf-8")
        context = browser.new_context(
            viewport={"width": width, "height": 900}, offline=True, **more
        )
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda m: said.append(m.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("dialog", lambda dialog: said.append(dialog.message))
        page.on("request", lambda request: said.append(request.url))
        page.goto(file.as_uri())
        assert said == [file.as_uri()]
        return page

    yield open_report
    for context in contexts:
        context.close()


def full() -> str:
    """Return a report with everything in it."""
    content = study("ifac93_6_3_3", "wang_young")
    corners = stress(2, True, content.plant.dt, content.plant.substeps)
    other = run_of(study("ifac93_6_3_3", "forward_path"))
    return report(content, uncertainty=corners, runs={"forward_path": other})


def test_a_report_opens_offline_and_gives_its_design(show: Show) -> None:
    """Nothing is fetched, and the link saves a file with the same design."""
    page = show(full())
    with page.expect_download() as waiting:
        page.get_by_role("link", name="Save design.json").click()
    assert waiting.value.suggested_filename == "design.json"
    saved = loads(Path(waiting.value.path()).read_text(encoding="utf-8"))
    wanted = study("ifac93_6_3_3", "wang_young")
    assert dumps(saved) == dumps(wanted)


def test_nothing_nasty_runs(show: Show) -> None:
    """A name that is a script is shown, not run."""
    model = lab.DifferenceModel([-0.5], [1.0], y_names=["<img src=x onerror=alert(1)>"])
    page = show(report(lab.Design("wang_young", model), title=NASTY))
    assert page.get_by_role("heading", level=1).inner_text() == NASTY
    assert page.title() == NASTY


@pytest.mark.parametrize("width", [390, 1024, 1920])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_and_can_be_read(show: Show, width: int, scheme: str) -> None:
    """No sideways scrolling; text and lines stand out from the ground."""
    page = show(full(), width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    ground = luminance(page, "body", "backgroundColor")
    assert (ground > 0.5) == (scheme == "light")
    for place, what, least in (
        ("body", "color", 7.0),
        (".quiet", "color", 4.5),
        ("thead th", "color", 4.5),
        (".good b", "color", 4.5),
        ("a", "color", 4.5),
        ("figure .style0", "stroke", 3.0),
        ("figure .style1", "stroke", 3.0),
    ):
        pair = sorted((luminance(page, place, what), ground))
        assert (pair[1] + 0.05) / (pair[0] + 0.05) >= least, place


def luminance(page: Page, place: str, what: str) -> float:
    """Return the relative luminance of a colour, as WCAG defines it."""
    text = page.locator(place).first.evaluate(f"part => getComputedStyle(part).{what}")
    levels = np.array([int(x) for x in re.findall(r"\d+", text)[:3]]) / 255.0
    bright = ((levels + 0.055) / 1.055) ** 2.4
    linear = np.where(levels <= 0.04045, levels / 12.92, bright)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_it_can_be_read_aloud(show: Show) -> None:
    """Figures have names and descriptions, tables captions and headings."""
    page = show(full())
    assert page.locator("html").get_attribute("lang") == "en"
    figures = page.get_by_role("img")
    count = page.locator("figure").count()
    assert figures.count() == count >= 7
    ids = page.evaluate("[...document.querySelectorAll('[id]')].map(part => part.id)")
    assert len(ids) == len(set(ids))
    first = page.get_by_role("img", name="Output and reference").first
    assert "wang_young: " in first.locator("desc").text_content()
    for row in page.locator("tbody tr").all():
        assert row.locator("th[scope=row]").count() == 1
    tables = page.locator("table").count()
    assert page.locator("caption").count() == tables
    assert page.locator("h1").count() == 1
    for link in page.get_by_role("navigation").get_by_role("link").all():
        assert page.locator(link.get_attribute("href")).count() == 1


def test_it_prints_on_paper(show: Show) -> None:
    """On A4 nothing is cut off, colours are those of paper, links are left out."""
    page = show(full(), 680, color_scheme="dark")  # 18 cm between the margins
    page.emulate_media(media="print", color_scheme="dark")
    assert luminance(page, "body", "backgroundColor") == pytest.approx(1.0)
    assert luminance(page, "body", "color") < 0.1
    assert page.evaluate("document.documentElement.scrollWidth") <= 680
    wide = "tables => tables.filter(t => t.scrollWidth > t.clientWidth + 1).length"
    assert page.locator(".table").evaluate_all(wide) == 0
    assert not page.get_by_role("navigation").is_visible()
    pages = page.pdf(prefer_css_page_size=True).count(b"/Type /Page\n")
    assert 2 <= pages <= 8
