"""Fields of radars are identified by name, in any case and order, by unit, or by choice."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read
from radarsdf.io.columns import Fields
from radarsdf.scans import Notes

# Fields of doppler and intensity, and all fields, of each sensor.
CLOUDS = {
    "Sensrad Hugin": ("doppler", "power", "x y z range doppler power"),
    "Oculii Eagle": ("doppler", "power", ("Doppler Range Power Alpha Beta x y z rangeAccu aziAccu eleAccu "
        "dopplerAccu recoveredSpeed denoiseFlag")),
    "ARS548, nebula": ("range_rate", "rcs", ("x y z azimuth azimuth_std elevation elevation_std range range_std "
        "range_rate range_rate_std rcs ambiguity_flag")),
    "ARS548, SNAIL-Radar": ("doppler", "intensity", ("x y z doppler intensity range_std azimuth_std elevation_std "
        "doppler_std")),
    "ARS548, HKUST RIO": ("velocity", "rcs", ("range azimuth elevation velocity rcs rangeSTD azimuthSTD elevationSTD "
        "velocitySTD")),
    "smartmicro": ("radial_speed", "power", ("x y z radial_speed power rcs noise snr azimuth_angle elevation_angle "
        "range")),
    "TI ti_mmwave": ("velocity", "intensity", "x y z intensity velocity"),
    "TI reve": ("v_doppler_mps", "snr_db", "x y z snr_db noise_db v_doppler_mps"),
    "radar_msgs/RadarScan": ("doppler_velocity", "amplitude", "range azimuth elevation doppler_velocity amplitude"),
    "View-of-Delft": ("v_r", "rcs", "x y z RCS v_r v_r_compensated time"),
    "TJ4DRadSet": ("v_r", "power", "X Y Z V_r Range Power Alpha Beta"),
}  # fmt: skip


def scan_of(fields, columns):
    return fields.scan(columns, np.eye(4), None, Notes())


@pytest.mark.parametrize("name", CLOUDS)
def test_fields_of_sensors(name):
    *roles, fields = CLOUDS[name]
    for names in (fields.split(), fields.split()[::-1], fields.upper().split()):
        by_role = {role: field.lower() for role, field in Fields.of(names).names.items()}
        assert [by_role["doppler"], by_role["intensity"]] == roles
        assert ("sigma_range" in by_role) == (name in ("Oculii Eagle",) or name.startswith("ARS548"))


def test_overrides():
    names = ["x", "y", "z", "doppler", "power", "rcs"]
    assert Fields.of(names, {"intensity": "RCS"}).names["intensity"] == "rcs"
    without_doppler = {"x": "x", "y": "y", "z": "z", "intensity": "rcs"}
    assert Fields.of(names, {"intensity": "RCS", "doppler": None}).names == without_doppler
    letters = {"x": "a", "y": "b", "z": "c"}
    assert Fields.of(["a", "b", "c"], letters).names == letters
    with pytest.raises(
        ValueError, match=r"no field snr for intensity: there are x, y, z, doppler, power, rcs"
    ):
        Fields.of(names, {"intensity": "snr"})
    with pytest.raises(ValueError, match=r"no role 'strength'"):
        Fields.of(names, {"strength": "power"})
    with pytest.raises(ValueError, match=r"the fields y, z are missing"):
        Fields.of(["x", "power"])
    with pytest.raises(ValueError, match=r"the fields azimuth, elevation are missing"):
        Fields.of(["r", "theta", "phi"])


def test_deviations():
    ones = np.ones(2)
    names = CLOUDS["Oculii Eagle"][2].split()
    cloud = scan_of(Fields.of(names), dict.fromkeys(names, ones))
    # In degrees, like its angles.
    assert_allclose(cloud.sigma, [[1, np.deg2rad(1), np.deg2rad(1)]] * 2, rtol=1e-6)
    names = CLOUDS["ARS548, nebula"][2].split()
    assert_array_equal(scan_of(Fields.of(names), dict.fromkeys(names, ones)).sigma, np.ones((2, 3)))


def test_a_field_of_strings_is_rejected():
    fields = Fields.of(["x", "y", "z", "power"])
    with pytest.raises(ValueError, match="the field power"):
        scan_of(fields, {name: np.zeros(1) for name in "xyz"} | {"power": np.array(["a"])})


def polar(text):
    """Points of a text table, and notes."""
    names, *rows = [line.split() for line in text.splitlines()]
    columns = dict(zip(names, np.array(rows, np.float64).T, strict=True))
    notes = Notes()
    return scan_of(Fields.of(names).with_unit(columns, notes), columns).points, notes.lines


@pytest.mark.parametrize(
    "columns",
    [{"x_cm": 300, "y [mm]": -4000, "z_km": 0.005, "doppler (km/h)": -36, "power": 7},
     {"X(m)": 3, "Y": -4, "Z": 5, "v_r_kmh": -36, "power": 7},
     {"x_ft": 3 / 0.3048, "y/in": -4 / 0.0254, "z [yd]": 5 / 0.9144, "v_r [knots]": -10 / 0.514444, "power [W]": 7},
     {"x (mile)": 3 / 1609.344, "y in mm": -4000, "z (µm)": 5e6, "Doppler (ft/min)": -600 / 0.3048, "rcs [what]": 7},
     {"range [feet]": 50**0.5 / 0.3048, "azimuth [gon]": np.arctan2(-4, 3) * 200 / np.pi, "elevation [rev]": 0.125,
      "speed (mph)": -10 / 0.44704, "power": 7},
     {"range": 50**0.5, "az (arcmin)": np.rad2deg(np.arctan2(-4, 3)) * 60, "el_grads": 50, "v_rad": -10, "power": 7},
     {"x": 3, "y": -4, "z": 5, "range [bins]": 1, "sigma_range [?]": 1, "rate": 0, "doppler (m s^-1)": -10, "power": 7},
     {"range_m": 50**0.5, "azimuth_mrad": 1e3 * np.arctan2(-4, 3), "elevation_deg": 45, "rdot_mps": -10, "power": 7}],
)  # fmt: skip
def test_units_in_names_become_metres_rad_and_metres_per_second(columns):
    rows = {name: np.full(2, value, np.float64) for name, value in columns.items()}
    notes = Notes()
    scan = scan_of(Fields.of(list(rows)).with_unit(rows, notes), rows)
    assert_allclose(scan.points, [[3, -4, 5]] * 2, rtol=1e-6)
    assert_allclose(scan.doppler_mps, [-10, -10], rtol=1e-6)
    assert (scan.intensities.tolist(), notes.lines) == ([7, 7], [])


@pytest.mark.parametrize(
    "columns",
    [
        "x [furlong],y,z",
        "x [deg],y,z",
        "x (ms),y,z",
        "x,y,z,doppler [Hz]",
        "range,azimuth [m],elevation",
        "x_s,y,z",
    ],
)
def test_an_unknown_unit_is_an_error_with_file_column_and_unit(tmp_path, columns):
    (tmp_path / "a.csv").write_text(f"{columns}\n1,2,3,4\n".replace(",4", ",4" * columns.count("doppler")))
    with pytest.raises(ValueError, match=r"a\.csv.*(x|doppler|azimuth).*unit '(furlong|deg|ms|hz|m|s)'"):
        len(read(tmp_path / "a.csv", [np.eye(4)]))


LEFT = np.array([[1, 1, 0]]) * 10 / np.sqrt(2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("range azimuth elevation\n10 45 0", "degrees by their values"),
        ("r az el\n10 45 0", "degrees by their values"),
        ("r_m az_deg el_deg\n10 45 0", None),
        ("range(mm) azimuth[deg] elevation\n10000 45 0", "degrees by their values"),
        ("range azimuth_rad elevation_rad\n10 0.78539816339745 0", None),
        ("range azimuth elevation\n10 0.78539816339745 0", "rad by their values"),
        (
            "scalar_Range scalar_Azimuth_Angle scalar_Elevation_Angle\n10 0.78539816339745 0",
            "rad by their values",
        ),
        # From 0 to a turn.
        ("range azimuth elevation\n10 0.78539816339745 0\n1 6.2 0.1", "rad by their values"),
    ],
)
def test_units_of_angles(text, said):
    points, notes = polar(text)
    assert_allclose(points[:1], LEFT, rtol=1e-6)
    assert len(notes) == (said is not None)
    assert said is None or said in notes[0]


@pytest.mark.parametrize(
    ("field", "role"),
    [("scalar_Intensity", "intensity"), ("snr_linear", "intensity"), ("RCS [dBsm]", "intensity"), ("rdot", "doppler"),
     ("v_radial", "doppler"), ("RadialVelocity", "doppler"), ("Doppler (m/s)", "doppler")],
)  # fmt: skip
def test_names_of_other_programs(field, role):
    assert Fields.of(["x", "y", "z", field]).names[role] == field


def test_an_intensity_in_linear_units_is_noted(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,snr_linear,rdot\n5,0,0,42,-3\n")
    scans = read(tmp_path / "a.csv", [np.eye(4)])
    assert scans.intensities[0].tolist() == [42]
    assert any("snr_linear" in note for note in scans.notes)
