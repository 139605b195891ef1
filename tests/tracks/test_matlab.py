"""MAT files: structs of columns, arrays of structs and vectors are tables; what only MATLAB reads is said."""

import numpy as np
import pytest
from scipy.io import savemat

from sameas.errors import InputError
from sameas.io.sensors import REPORT_FORMATS, ReadOptions, read_reports, read_sources

START, N = 1714560000.0, 6
TIMES = START + 3.0 * np.arange(N)


def test_structs_of_columns_are_sources(tmp_path):
    radar = {"time": TIMES, "range_km": 5.0 + 0.1 * np.arange(N), "bearing_deg": 40.0 + np.arange(N), "quality": "good",
             "track_id": np.array([f"T{k}" for k in range(N)], object), "site": np.eye(4)}  # fmt: skip
    ais = {"t": TIMES, "lat": np.full(N, 50.1), "lon": np.full(N, -1.2), "mmsi": np.full(N, 235070762)}
    savemat(tmp_path / "harbour.mat", {"radar": radar, "day": {"ais": ais}, "comment": "a run"})
    plots, fixes = read_sources([tmp_path / "harbour.mat"])
    assert [one.description.name for one in (plots, fixes)] == ["harbour:radar", "harbour:day.ais"]
    assert [one.description.kind for one in (plots, fixes)] == ["marine radar", "ais"]
    assert plots.reports.range_m.tolist() == pytest.approx((5000 + 100 * np.arange(N)).tolist())
    assert plots.reports.track_id.tolist() == [f"T{k}" for k in range(N)]
    assert set(fixes.reports.mmsi) == {"235070762"} and fixes.reports.time_s.tolist() == TIMES.tolist()
    assert "mat" in REPORT_FORMATS


def test_an_array_of_structs_is_a_table(tmp_path):
    kinds = [("Time", "O"), ("Position", "O"), ("ID", "O")]
    rows = [(TIMES[k], np.array([10.0 * k, -5.0, 3.0]), f"a{k % 2}") for k in range(N)]
    savemat(tmp_path / "detections.mat", {"detections": np.array(rows, kinds)})
    [made] = read_reports(tmp_path / "detections.mat", ReadOptions(source="lidar"))
    assert (made.source, made.position) == ("lidar", "local")
    assert made.x_m.tolist() == [10.0 * k for k in range(N)] and set(made.track_id) == {"a0", "a1"}


@pytest.mark.parametrize("turned", [False, True])
def test_vectors_and_matrices_of_one_length_are_a_table(tmp_path, turned):
    place = np.column_stack([np.arange(N) * 2.0, np.arange(N) * 3.0])
    variables = {"t": TIMES / 86400.0 + 719529.0, "pos": place.T if turned else place, "scale": 3.0}
    savemat(tmp_path / "tracks.mat", variables, do_compression=True)
    [made] = read_reports(tmp_path / "tracks.mat")
    np.testing.assert_allclose(made.time_s, TIMES, atol=1e-3)
    assert made.y_m.tolist() == place[:, 1].tolist() and "days of MATLAB" in "".join(made.notes)


def test_missing_numbers_are_absent(tmp_path):
    lat = np.full(N, 50.1)
    lat[2] = np.nan
    savemat(tmp_path / "ais.mat", {"ais": {"time": TIMES, "lat": lat, "lon": np.full(N, -1.2)}})
    [made] = read_reports(tmp_path / "ais.mat")
    assert len(made) == N - 1 and made.damaged.lines.tolist() == [3] and made.damaged.unit == "record"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(500), "version 7.3; save it with '-v7'; write tables with"),
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + b"\x07" * 500, "cannot be read as a MAT file"),
    ],
)
def test_other_mat_files_are_refused_with_a_remedy(tmp_path, content, words):
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_reports(tmp_path / "a.mat")


def test_a_file_without_a_table_is_refused(tmp_path):
    savemat(tmp_path / "a.mat", {"x": 3.0, "name": "radar", "image": np.ones((50, 40))})
    with pytest.raises(InputError, match="neither structs of columns nor vectors of one length; write tables with"):
        read_reports(tmp_path / "a.mat")
