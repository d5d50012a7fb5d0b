"""Text of other programs is read without loss of a line, or rejected."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read
from radarsdf.io.clouds import read_columns
from radarsdf.io.columns import are_degrees, in_seconds, read_numbers
from radarsdf.io.poses import read_poses, trajectory_of
from radarsdf.io.recordings import times_in
from radarsdf.scans import Notes

ROWS = np.array([[1.5, -2, 3, 40.25], [4, 5.125, 6, 70], [7, 8, 9e-2, 10]])
TUM = np.array([[10.0, 1, 2, 3, 0, 0, 0, 1], [10.25, 2, 2, 3, 0, 0, 1, 0], [10.5, 3, 2, 3, 0, 0, 0, 1]])


def table(rows, separator=" ", comma=".", end="\n"):
    return "".join(
        separator.join(repr(number).replace(".", comma) for number in row) + end for row in rows.tolist()
    )


ENCODINGS = ["utf-8", "utf-8-sig"]
LAYOUTS = {
    "spaces": table,
    "commas": lambda rows: table(rows, ", "),
    "tabs": lambda rows: table(rows, "\t"),
    "semicolons": lambda rows: table(rows, ";"),
    "decimal commas": lambda rows: table(rows, " ; ", ","),
    "CR": lambda rows: table(rows, end="\r"),
    "CRLF": lambda rows: table(rows, ",", end="\r\n"),
    "blank lines": lambda rows: "\n\n" + table(rows, end="\n\n") + "\n  \n\n",
    "comments": lambda rows: "# by; hand, twice\n// and more\n% here\n" + table(rows, ",", end=" # a; 1,5\n"),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_same_numbers_in_all_layouts(tmp_path, layout, encoding):
    (tmp_path / "a.csv").write_bytes(LAYOUTS[layout](ROWS).encode(encoding))
    assert_array_equal(np.transpose(list(read_columns(tmp_path / "a.csv").values())), ROWS)
    (tmp_path / "poses.txt").write_bytes(LAYOUTS[layout](TUM).encode(encoding))
    for trajectory in (
        read_poses(tmp_path / "poses.txt", Notes()),
        trajectory_of(read_numbers(tmp_path / "poses.txt"), ""),
    ):
        assert_array_equal(trajectory.times_s, TUM[:, 0])
        assert_array_equal(trajectory.positions, TUM[:, 1:4])


@pytest.mark.parametrize("text", ["\x001 2 3\n4 5\n6\n", "1 2 3\n4 5\n6\n"])
@pytest.mark.parametrize("function", [read_columns, read_numbers])
def test_no_line_is_lost(tmp_path, text, function):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match=r"a\.csv"):
        function(tmp_path / "a.csv")


@pytest.mark.parametrize("wrong", ["4 5 six", "4 5", "4,,6", "m m m", "4 5 6 7 8"])
@pytest.mark.parametrize("head", ["", "x y z\n"])
def test_a_row_that_is_none_is_left_out_of_a_cloud_and_counted(tmp_path, wrong, head):
    head, wrong = (text.replace(" ", ",") for text in (head, wrong))
    (tmp_path / "a.csv").write_text(f"{head}1,2,3\n{wrong}\n7,8,9\n")
    scans = read(tmp_path / "a.csv", [np.eye(4)])
    assert_array_equal(scans.points[0], [[1, 2, 3], [7, 8, 9]])
    assert scans.notes == ["1 returns left out: a coordinate or the intensity is not a finite number"]
    with pytest.raises(ValueError, match=r"a\.csv"):
        read_numbers(tmp_path / "a.csv")


# Association of scans, poses and times in a folder.

POSES = np.tile(np.eye(4), (4, 1, 1))
POSES[:, 0, 3] = [10, 20, 30, 40]


@pytest.fixture
def folder(tmp_path):
    """Four scans, 0.csv to 3.csv: scan i has its return at x = i + 1 and its KITTI pose at 10 (i + 1)."""
    for i in range(4):
        (tmp_path / f"{i}.csv").write_text(f"{i + 1} 0 0 {i}\n")
    (tmp_path / "poses.txt").write_text("".join(" ".join(map(str, p[:3].ravel())) + "\n" for p in POSES))
    return tmp_path


def pairs(scans):
    """Positions of return and sensor in each scan."""
    return [(float(scan.points[0, 0]), float(scan.T_world_sensor[0, 3])) for scan in scans]


def test_each_scan_keeps_its_pose_where_times_do_not_ascend(folder):
    (folder / "times.txt").write_text("0.3\n0.1\n0.2\n0.4\n")
    for poses in (None, POSES):
        scans = read(folder, poses)
        assert pairs(scans) == [(2, 20), (3, 30), (1, 10), (4, 40)]
        assert scans.times_s.tolist() == [0.1, 0.2, 0.3, 0.4]
    (folder / "times.txt").write_text("0.1\n0.2\n0.3\n0.4\n")
    assert not any("times.txt" in note for note in read(folder).notes)


def test_times_may_be_in_other_units(folder):
    start_s = 1_700_000_000
    tum = "".join(f"{start_s + i} {10 * i + 10} 0 0 0 0 0 1\n" for i in range(4))
    (folder / "poses.txt").write_text(tum)
    (folder / "times.txt").write_text("".join(f"{1_000_000_000 * (start_s + i)}\n" for i in range(4)))
    scans = read(folder, max_gap_s=1.5)
    assert pairs(scans) == [(1, 10), (2, 20), (3, 30), (4, 40)]
    assert "times of times.txt are taken as ns since 1970" in scans.notes
    (folder / "times.txt").write_text("# time [min]\n" + "".join(f"{i}\n" for i in range(4)))
    assert read(folder, POSES).times_s.tolist() == [0, 60, 120, 180]


@pytest.mark.parametrize(
    ("time", "time_s", "unit"),
    [(9.9e10, 9.9e10, "s"), (1.1e11, 1.1e8, "ms"), (9.9e13, 9.9e10, "ms"), (1.1e14, 1.1e8, "µs"),
     (9.9e16, 9.9e10, "µs"), (1.1e17, 1.1e8, "ns"), (-1.1e11, -1.1e8, "ms")],
)  # fmt: skip
def test_large_times_are_in_the_unit_that_makes_them_a_date(time, time_s, unit):
    notes = Notes()
    assert_allclose(in_seconds(np.array([time]), "a.txt", notes), [time_s], rtol=1e-12)
    assert notes.lines == [f"times of a.txt are taken as {unit} since 1970"] * (unit != "s")
    assert len(in_seconds(np.zeros(0), "a.txt", notes)) == 0


@pytest.mark.parametrize(
    ("stem", "time_s"),
    [("12.5", 12.5), ("scan_1700000000123", 1700000000.123), ("1700000000_250000000", 1700000000.25), ("1234567890", 1234567890.0),
     ("170000000-500000000", 170000000.5), ("1700000000250000000", 1700000000.25), ("1700000000.25_radar", 1700000000.25),
     ("2023-11-14T22:13:20.250Z", 1700000000.25), ("2023-11-14-22-13-20.25", 1700000000.25), ("20231114_221320_250", 1700000000.25),
     ("radar_20231114221320250", 1700000000.25), ("14-11-2023_22-13-20.25", 80000.25)],
)  # fmt: skip
def test_names_of_files_end_in_times(stem, time_s):
    notes = Notes()
    assert times_in([stem], notes) == [pytest.approx(time_s, rel=1e-15)]
    assert len(notes.lines) == 1


@pytest.mark.parametrize(
    "name",
    ["scan_{:09d}", "{}", "{:010d}", "20231114_{:06d}", "20231114_221320_{:03d}", "20231114_221320_{}", "1700000000_{}",
     "1700000000_{:06d}", "run2.{:04d}"],
)  # fmt: skip
def test_numbers_of_scans_are_no_times(name):
    for count in (9, 40):
        assert times_in([name.format(i + 1) for i in range(count)], Notes()) is None
    assert times_in([f"5.{i + 1}" for i in range(40)], Notes()) is None


@pytest.mark.parametrize("separator", [".", "_", "-"])
@pytest.mark.parametrize(("unit", "jitter"), [(1, 0), (1, 3e6), (10**3, 3e6), (10**6, 3e6)])
def test_fractions_without_leading_zeros_are_found_by_even_steps(separator, unit, jitter):
    rng = np.random.default_rng(0)
    times_ns = 1_700_000_899_040_000_000 + np.cumsum(103_000_000 + jitter * rng.normal(size=40)).astype(int)
    names = [f"{t // 10**9}{separator}{t % 10**9 // unit}" for t in times_ns.tolist()]
    notes = Notes()
    assert_allclose(times_in(names, notes), times_ns * 1e-9, rtol=0, atol=1.1e-3)
    assert "without leading zeros" in notes.lines[0]
    decimals = [str(t * 1e-9) for t in times_ns.tolist()]  # loses zeros at the end
    assert_allclose(times_in(decimals, notes), times_ns * 1e-9, rtol=0, atol=1e-6)
    assert not any("undecided" in line for line in notes.lines)


def test_times_that_could_be_read_in_two_ways_or_are_uneven_are_noted():
    notes = Notes()
    times_in([f"{1_700_000_000 + i}.40000000" for i in range(5)], notes)  # 0.4 s or 40,000,000 ns
    assert "undecided" in notes.lines[0]
    times_in(["1.0", "2.0", "3.0", "7.0"], notes)
    assert "1 of 3 steps" in notes.lines[1]


@pytest.mark.parametrize(
    ("azimuths", "elevation", "degrees"),
    [((-1.04, 1.04), 0, False), ((-1.06, 1.06), 0, True), ((0, 2.09, 2.09), 0, False), ((0, 2.12, 2.12), 0, True),
     ((0, 1), 0.52, False), ((0, 1), -0.53, True), ((0, np.nan), 9, True), ((np.nan, np.nan), 9, False)],
)  # fmt: skip
def test_angles_beyond_what_rad_can_be_are_degrees(azimuths, elevation, degrees):
    azimuth = np.pi * np.repeat(azimuths, 100)
    assert are_degrees(azimuth, np.full(len(azimuth), np.pi * elevation)) is degrees
