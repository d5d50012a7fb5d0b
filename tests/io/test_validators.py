"""Outputs as strict readers and the validators of other projects see them."""

import json
import os
import shutil
import struct
import subprocess
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.io import Scans, write_mesh

_VALIDATE = """
const validator = require(process.argv[1] + "/gltf-validator");
const content = new Uint8Array(require("fs").readFileSync(process.argv[2]));
validator.validateBytes(content).then(found => console.log(JSON.stringify(found.issues)));
"""


def refuse(constant):
    pytest.fail(f"{constant} in JSON")


def tree_of(path):
    content = path.read_bytes()
    (size,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + size], parse_constant=refuse)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A coloured GLB file with NaN attributes, and those of 3D Tiles with a name that must be encoded."""
    folder = tmp_path_factory.mktemp("outputs")
    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.tile(np.array([188, 0, 255, 255], np.uint8), (8, 1))
    mesh.vertex_attributes |= {"confidence": np.ones(8, np.float32), "uncertainty_m": np.full(8, np.nan)}
    mesh.metadata["expected_precision"] = float("nan")
    write_mesh(folder / "mesh.glb", mesh)
    scene = radarsdf.simulate.wall(seed=5, frames=8)
    config = radarsdf.FitConfig.quick()
    city = radarsdf.fit_tiles(
        Scans(scene.points, scene.poses), folder / "city", tile_size=16, config=config, progress=False
    )
    city.export(folder / "a #5 50%25.json", 0.2, progress=False)
    return folder


def test_glb_is_strict_json_with_linear_colors_and_a_matt_material(files):
    tree = tree_of(files / "mesh.glb")
    (primitive,) = tree["meshes"][0]["primitives"]
    assert set(primitive["attributes"]) >= {"POSITION", "COLOR_0", "_confidence"}
    assert "_uncertainty_m" not in primitive["attributes"]
    color = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    np.testing.assert_allclose(color["max"], [0.503, 0, 1], atol=1e-3)
    assert tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0


def test_uris_of_3d_tiles_are_encoded(files):
    tileset = json.loads((files / "a #5 50%25.json").read_text(), parse_constant=refuse)
    uris = [child["content"]["uri"] for child in tileset["root"]["children"]]
    assert uris
    assert not any(set(uri) & set("# ") for uri in uris)
    assert all((files / unquote(uri)).is_file() for uri in uris)


def test_gltf_validator_finds_no_fault(files):
    modules = os.environ.get("RADARSDF_NODE_MODULES", "")
    if not shutil.which("node") or not (Path(modules) / "gltf-validator").is_dir() or not modules:
        pytest.skip("RADARSDF_NODE_MODULES names no folder with gltf-validator, or there is no node")
    for path in files.rglob("*.glb"):
        command = ["node", "-e", _VALIDATE, str(Path(modules).resolve()), str(path)]
        issues = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), (path, issues["messages"])


def test_las_files_follow_the_specification(tmp_path):
    laspy = pytest.importorskip("laspy")
    radarsdf.io.write_cloud(tmp_path / "cloud.las", Scans([np.ones((3, 3))], [np.eye(4)]))
    las = laspy.read(tmp_path / "cloud.las")
    assert las.header.point_format.id >= 6
    assert las.header.global_encoding.wkt  # required from format 6 on
    assert set(las.return_number) == set(las.number_of_returns) == {1}
