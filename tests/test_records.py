"""Records: reading, writing, cutting and detrending sampled data."""

import io
import pickle

import numpy as np
import pandas
import pytest
import scipy.io
from conftest import ROOT

from nmss_lab.records import SHIPPED, Record, shipped

CSV = """time [s],T1 [degC], Q1 [%],ambient,note
0.0,20.0,0,21.0,start
0.5,20.5,50,21.1,
1.0,21.25,50,21.2,door
"""


def sample(n: int = 20) -> Record:
    """Two outputs with references, one input and one disturbance, dt = 0.1."""
    rng = np.random.default_rng(1)
    return Record(
        time=0.1 * np.arange(n),
        y=rng.normal(size=(n, 2)),
        u=rng.normal(size=n),
        v=rng.normal(size=n),
        r=rng.normal(size=(n, 2)),
        names={"y": ("level", "T"), "u": ("valve",)},
        units={"level": "m", "T": "degC", "time": "s"},
    )


def test_columns_are_read_by_name_with_their_units():
    """Names and units come from the header; other columns are ignored."""
    record = Record.from_csv(
        io.StringIO(CSV), y=["T1"], u=["Q1"], v=["ambient"], time="time"
    )
    assert record.y.tolist() == [[20.0], [20.5], [21.25]]
    assert record.u.tolist() == [[0.0], [50.0], [50.0]]
    assert record.v.tolist() == [[21.0], [21.1], [21.2]]
    assert record.r.shape == (3, 0)
    assert record.names == {"y": ("T1",), "u": ("Q1",), "v": ("ambient",), "r": ()}
    assert record.units == {"T1": "degC", "Q1": "%", "time": "s"}
    assert record.dt == 0.5


def test_interval_replaces_a_time_column():
    """With dt the samples are numbered from time 0."""
    record = Record.from_csv(io.StringIO(CSV), y=["T1"], dt=9.0)
    assert record.time.tolist() == [0.0, 9.0, 18.0]
    assert record.u.shape == (3, 0)


def test_written_file_reads_back_without_loss(tmp_path):
    """CSV keeps every digit, every name and every unit."""
    record = sample()
    path = tmp_path / "record.csv"
    record.to_csv(path)
    back = Record.from_csv(
        path, y=["level", "T"], u=["valve"], v=["v1"], r=["r1", "r2"], time="time"
    )
    assert np.array_equal(back.values, record.values)
    assert np.array_equal(back.time, record.time)
    assert back.names == record.names
    assert back.units == record.units


def test_spreadsheet_byte_order_mark_and_blank_lines_do_no_harm(tmp_path):
    """Files saved by spreadsheets read like any other."""
    path = tmp_path / "excel.csv"
    path.write_text("\ufeffy,u\r\n1,2\r\n\r\n3,4\r\n", encoding="utf-8", newline="")
    record = Record.from_csv(path, y=["y"], u=["u"], dt=1.0)
    assert record.values.tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("y,u\n1,2\n\n1,x\n", r"row 4, column 'u': 'x' is not a finite number"),
        ("y,u\n1,2\n1\n", r"row 3, column 'u': '' is not"),
        ("y,u\n1,nan\n", r"row 2, column 'u': 'nan' is not"),
        ("y,w\n1,2\n", r"column 'u' is missing; the file has \['y', 'w'\]"),
        ("y,u,u\n1,2,3\n", r"column 'u' is there more than once"),
        ("y,u\n", "no data below its header"),
        ("", "column 'y' is missing"),
    ],
)
def test_bad_files_are_refused_by_row_and_column(text, message):
    """The message leads to the cell."""
    with pytest.raises(ValueError, match=message):
        Record.from_csv(io.StringIO(text), y=["y"], u=["u"], dt=1.0)


def test_exactly_one_source_of_time():
    """Time stamps and an interval at once, or neither, is a mistake."""
    for options in ({}, {"time": "t", "dt": 1.0}):
        with pytest.raises(ValueError, match="either time"):
            Record.from_csv(io.StringIO("y\n1\n"), y=["y"], **options)
    with pytest.raises(ValueError, match="dt is -1"):
        Record.from_csv(io.StringIO("y\n1\n"), y=["y"], dt=-1)
    for columns in ([], "y"):
        with pytest.raises(ValueError, match="expected a list of column names"):
            Record.from_csv(io.StringIO("y\n1\n"), y=columns, dt=1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time": [0.0, 1.0]}, r"y has shape \(3, 1\); expected \(2, n\)"),
        ({"time": [0.0, 1.0, 1.0]}, "time does not increase at row 2"),
        ({"time": []}, r"time has shape \(0,\)"),
        ({"u": [1.0, np.nan, 1.0]}, "column 'u1', row 1 is nan"),
        ({"time": [0.0, np.inf, 1.0]}, "column 'time', row 1 is inf"),
        ({"y": np.zeros((3, 2)), "r": np.zeros(3)}, "r has 1 columns; expected 2"),
        ({"y": []}, "y has no column"),
        ({"names": {"y": ("a", "b")}}, r"names\['y'\] has 2 names, not 1"),
        ({"names": {"z": ("a",)}}, "groups"),
        ({"names": {"y": ("u1",)}}, "column names must differ"),
        ({"units": {"T9": "K"}}, "unknown columns"),
    ],
)
def test_constructor_names_what_is_wrong(changes, message):
    """Each check says which argument, and where."""
    fields = {"time": [0.0, 1.0, 2.0], "y": [1.0, 2.0, 3.0], "u": [1.0, 2.0, 3.0]}
    with pytest.raises(ValueError, match=message):
        Record(**{**fields, **changes})


def test_records_cannot_be_changed_and_travel():
    """Arrays are read-only copies; pickling keeps everything."""
    y = np.zeros(3)
    record = Record(time=np.arange(3.0), y=y)
    y[0] = 7.0
    assert record.y[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        record.y[0] = 1.0
    assert np.array_equal(pickle.loads(pickle.dumps(sample())).values, sample().values)


def test_irregular_sampling_says_where():
    """A missing sample is found; rounded time stamps are not held against a record."""
    time = np.delete(np.arange(10.0), 4)
    with pytest.raises(ValueError, match=r"interval is 1 but 2 between rows 3 and 4"):
        _ = Record(time=time, y=time).dt
    rounded = np.round(np.arange(100) / 3, 4)
    assert Record(time=rounded, y=rounded).dt == pytest.approx(1 / 3, abs=1e-6)
    with pytest.raises(ValueError, match="one sample"):
        _ = Record(time=[0.0], y=[1.0]).dt


def test_detrending_removes_exactly_that_trend():
    """Mean, line and first value; references move with their outputs."""
    record = sample()
    constant, linear, first = (
        record.detrend(kind) for kind in ("constant", "linear", "first")
    )
    slopes = np.polyfit(record.time, np.column_stack([linear.y, linear.u]), 1)
    assert np.abs(constant.y.mean(axis=0)).max() < 1e-15
    assert np.abs(slopes).max() < 1e-13
    assert not first.y[0].any()
    assert not first.v[0].any()
    for kept in (constant, linear, first):
        assert np.allclose(kept.r - kept.y, record.r - record.y, rtol=0, atol=1e-15)
    alone = record.detrend("first", ["y"])
    assert np.array_equal(alone.u, record.u)
    assert np.array_equal(alone.y, first.y)
    with pytest.raises(ValueError, match="expected some of"):
        record.detrend("first", ["r"])
    with pytest.raises(ValueError, match="'quadratic'"):
        record.detrend("quadratic")


def test_selection_and_split_are_complementary():
    """Half-open in time, and forgiving about 0.1 + 0.2."""
    record = sample()
    early, late = record.split(time=0.3)
    assert early.time.size == 3
    assert np.array_equal(late.values, record.select(start=0.3).values)
    assert np.array_equal(early.values, record.select(stop=0.3).values)
    first, second = record.split(0.75)
    assert (first.time.size, second.time.size) == (15, 5)
    assert first.names == record.names
    assert np.array_equal(np.vstack([first.values, second.values]), record.values)


def test_empty_parts_are_refused():
    """A cut outside the record is an error, not an empty record."""
    record = sample()
    with pytest.raises(ValueError, match=r"runs from 0 to 1\.9"):
        record.select(5.0, 6.0)
    with pytest.raises(ValueError, match="time 5 leaves"):
        record.split(time=5.0)
    with pytest.raises(ValueError, match="fraction 1 leaves"):
        record.split(1.0)
    with pytest.raises(ValueError, match="either fraction or time"):
        record.split()


DATES = """when,y [degC],u
2026-03-29T01:30:00+01:00,1,0
2026-03-29T03:30:00+02:00,2,1
2026-03-29T02:30:00Z,3,1
"""


def test_dates_with_a_zone_become_seconds():
    """An hour is an hour, across summer time and between zones."""
    record = Record.from_csv(io.StringIO(DATES), y=["y"], u=["u"], time="when")
    assert record.time.tolist() == [0.0, 3600.0, 7200.0]
    assert record.units == {"y": "degC", "time": "s"}
    plain = DATES.replace("+01:00", "").replace("+02:00", "").replace("Z", "")
    with pytest.raises(ValueError, match=r"row 4.*does not come after the row before"):
        Record.from_csv(io.StringIO(plain), y=["y"], time="when")


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ("0 1 1", "row 4, column 't': '1' does not come after"),
        ("0 soon 2", "row 3, column 't': 'soon' is neither a finite number nor an ISO"),
        ("0 2026-01-01 2", "row 3, column 't': '2026-01-01' is a date among numbers"),
        ("2026-01-01 5 2026-01-02", "row 3, column 't': '5' is a number among dates"),
    ],
)
def test_bad_times_are_named(cells, message):
    """Time has to be one kind and to increase."""
    text = "t,y\n" + "".join(f"{cell},1\n" for cell in cells.split())
    with pytest.raises(ValueError, match=message):
        Record.from_csv(io.StringIO(text), y=["y"], time="t")


BROKEN = "t,y,u\n0,1,0\n1,oops,0\n2,3,1\n3,4,\n2.5,9,1\n4,5,1\n"


def test_bad_rows_are_all_named_and_skipped_on_request():
    """By default a file with bad rows is refused; skipping leaves a note and a gap."""
    with pytest.raises(ValueError, match=r"row 3, column 'y': 'oops'.*1 more .*: 5"):
        Record.from_csv(io.StringIO(BROKEN), y=["y"], u=["u"], time="t")
    record = Record.from_csv(
        io.StringIO(BROKEN), y=["y"], u=["u"], time="t", bad="skip"
    )
    assert record.time.tolist() == [0.0, 2.0, 2.5, 4.0]
    assert record.notes[0].startswith("left out: row 3, column 'y': 'oops'")
    assert record.detrend("first").notes == record.notes
    with pytest.raises(ValueError, match="no data"):
        Record.from_csv(io.StringIO("y\nx\n"), y=["y"], dt=1.0, bad="skip")
    with pytest.raises(ValueError, match='expected "refuse" or "skip"'):
        Record.from_csv(io.StringIO("y\n1\n"), y=["y"], dt=1.0, bad="ignore")


def test_a_frame_reads_like_its_file():
    """Numbers and dates of pandas, the index as time, missing values by row."""
    frame = pandas.read_csv(io.StringIO(DATES))
    frame["when"] = pandas.to_datetime(frame["when"], utc=True)
    from_file = Record.from_csv(io.StringIO(DATES), y=["y"], u=["u"], time="when")
    for table in (frame, frame.set_index("when")):
        record = Record.from_frame(table, y=["y"], u=["u"], time="when")
        assert np.array_equal(record.time, from_file.time)
        assert np.array_equal(record.values, from_file.values)
        assert record.units == from_file.units
    holed = pandas.DataFrame({"y": [1.0, None, 3.0]})
    with pytest.raises(ValueError, match="row 1, column 'y': nan is not a finite"):
        Record.from_frame(holed, y=["y"], dt=1.0)


def test_matlab_files(tmp_path):
    """Vectors by name, columns of a matrix by number; other variables do no harm."""
    path = tmp_path / "record.mat"
    y, U = np.arange(5.0), np.arange(10.0).reshape(5, 2)
    scipy.io.savemat(path, {"y": y, "U": U, "t": 2 * y, "who": "me", "long": y[:3]})
    record = Record.from_file(path, y=["y"], u=["U2"], v=["U1"], time="t")
    assert record.y.ravel().tolist() == y.tolist()
    assert np.array_equal(np.hstack([record.v, record.u]), U)
    assert record.dt == 2.0
    with pytest.raises(ValueError, match="column 'z' is missing; the file has"):
        Record.from_file(path, y=["z"], dt=1.0)
    with pytest.raises(ValueError, match="differ in length"):
        Record.from_file(path, y=["y"], u=["long"], dt=1.0)


@pytest.mark.parametrize(
    ("name", "reader", "row"),
    [("a.xlsx", "read_excel", 3), ("a.parquet", "read_parquet", 1)],
)
def test_tables_through_pandas(name, reader, row, tmp_path, monkeypatch):
    """Real files; spreadsheet rows count from the header; no library, a clear word."""
    frame = pandas.DataFrame({"y [K]": [1.0, 2.0], "u": ["3.0", "x"]})
    written = {"read_excel": {"index": False}, "read_parquet": {}}[reader]
    getattr(frame, reader.replace("read", "to"))(tmp_path / name, **written)
    record = Record.from_file(tmp_path / name, y=["y"], dt=1.0)
    assert record.units == {"y": "K"}
    assert record.y.ravel().tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match=f"row {row}, column 'u': 'x'"):
        Record.from_file(tmp_path / name, y=["y"], u=["u"], dt=1.0)

    def missing(path):
        raise ImportError("no such library")

    monkeypatch.setattr(pandas, reader, missing)
    extra = reader.removeprefix("read_")
    with pytest.raises(ValueError, match=rf"pip install .nmss-lab\[{extra}\]"):
        Record.from_file(tmp_path / name, y=["y"], dt=1.0)
    with pytest.raises(ValueError, match=r"unknown ending '\.txt'"):
        Record.from_file(tmp_path / "a.txt", y=["y"], dt=1.0)


def test_gaps_are_reported_and_bridged_only_on_request():
    """Where, how long, how many; inputs are held, outputs go along a line."""
    time = np.delete(np.arange(8.0), [3, 4])
    record = Record(time=time, y=10 * time, u=time, r=time)
    (gap,) = record.gaps()
    assert (gap.row, gap.start, gap.stop, gap.missing) == (2, 2.0, 5.0, 2)
    assert str(gap) == "3 instead of 1 after row 2 (time 2), 2 samples missing"
    with pytest.raises(ValueError, match="irregular"):
        _ = record.dt
    even = record.resample(1.0)
    assert even.gaps() == ()
    assert even.y.ravel().tolist() == [0, 10, 20, 30, 40, 50, 60, 70]
    assert even.u.ravel().tolist() == [0, 1, 2, 2, 2, 5, 6, 7]
    assert even.notes == ("resampled every 1 (linear, 1 odd intervals, longest 3)",)
    held = record.resample(0.5, "previous")
    assert held.y.ravel()[4:11].tolist() == [20, 20, 20, 20, 20, 20, 50]


def test_resampling_at_the_old_times_changes_nothing():
    """Also where 0.1 is no binary number; nonsense is refused."""
    record = sample()
    for method in ("linear", "previous"):
        same = record.resample(0.1, method)
        assert np.allclose(same.values, record.values, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="dt = 0"):
        record.resample(0.0)
    with pytest.raises(ValueError, match=r"at most 1\.9"):
        record.resample(2.0)
    with pytest.raises(ValueError, match="method = 'cubic'"):
        record.resample(0.1, "cubic")


def test_one_output_with_all_inputs():
    """What a model of one output is fitted to."""
    record = sample()
    one = record.output("T")
    assert np.array_equal(one.y[:, 0], record.y[:, 1])
    assert one.columns == ("T", "valve", "v1")
    assert one.units == {"T": "degC", "time": "s"}
    with pytest.raises(ValueError, match="no output 'valve'"):
        record.output("valve")


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_records_say_where_they_come_from(name):
    """Each has its licence beside it and a line in the table of sources."""
    record = shipped(name)
    folder = ROOT / "nmss_lab" / "data"
    licence = (folder / f"{name}.csv.license").read_text(encoding="utf-8")
    assert "SPDX-License-Identifier" in licence
    assert f"`{name}.csv` | {len(record.time)} |" in (folder / "README.md").read_text(
        encoding="utf-8"
    )
    assert record.resample(round(np.median(np.diff(record.time)))).gaps() == ()
    assert max((gap.missing for gap in record.gaps()), default=0) == 0
    assert record.units["time"] == "s"
    with pytest.raises(ValueError, match="expected one of"):
        shipped("hair_dryer")
