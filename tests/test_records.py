"""Records: reading, writing, cutting and detrending sampled data."""

import io
import pickle

import numpy as np
import pytest

from nmss_lab.records import Record

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
