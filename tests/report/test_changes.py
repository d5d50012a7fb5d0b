# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The report of what changed names each change, lists it and shows it."""

import numpy as np
import pytest
from radarsdf.changes.changes import (
    APPEARED,
    COLORS,
    MOVED,
    NAMES,
    REFLECTANCE_CHANGED,
    SAME,
    ChangedSurface,
    Changes,
)
from radarsdf.view.pages import centre_of

from .reading import Page

HOSTILE = "<script>alert(1)</script>.safetensors"


def surface(kinds):
    """A sheet of 2 × 2 m for each kind, side by side."""
    steps = np.linspace(0, 2, 9)
    sheet = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), -1).reshape(-1, 3)
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).reshape(-1)
    faces = np.concatenate([corner[:, None] + [0, 9, 1], corner[:, None] + [1, 9, 10]])
    count = len(sheet)
    vertices = np.concatenate([sheet + [0, 3.0 * number, 0] for number in range(len(kinds))])
    faces = np.concatenate([faces + count * number for number in range(len(kinds))]).astype(np.int32)
    kind = np.repeat(np.array(kinds, np.int8), count)
    moved = np.where(kind == MOVED, 0.25, np.nan).astype(np.float32)
    change = np.where(kind == REFLECTANCE_CHANGED, 6.5, np.nan).astype(np.float32)
    return ChangedSurface(vertices, faces, kind, np.full(len(kind), 0.9, np.float32), moved, change)


@pytest.mark.parametrize("kinds", [[SAME], [SAME, APPEARED, MOVED, REFLECTANCE_CHANGED]])
def test_each_change_is_named_listed_and_shown(kinds, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from radarsdf.report import changes as module  # noqa: PLC0415

    scene, shown = module.scene, []
    monkeypatch.setattr(module, "scene", lambda *mesh: shown.append(mesh) or scene(*mesh))
    areas_m2 = {NAMES[kind]: 4.0 * kinds.count(kind) for kind in (APPEARED, 1, MOVED, REFLECTANCE_CHANGED)}
    report = {
        "alignment": "As <b>given</b>.",
        "areas_m2": areas_m2,
        "compared_m2": 20.0,
        "reflectance": "+0.4",
    }
    changes = Changes(surface([SAME]), surface(kinds), np.eye(4), report)
    regions, path = changes.regions(0.1), tmp_path / "changes.html"
    assert (
        module.write_changes_report(path, changes, ("monday", HOSTILE), 0.2, regions) == path.stat().st_size
    )
    np.testing.assert_allclose(shown[0][0].mean(axis=0), 0, atol=1e-9)  # the page computes in float32
    page = Page(path.read_text("utf-8"))
    assert "As <b>given</b>." in page.sections["conclusion"]
    for region in regions:
        assert region.kind.capitalize() in page.sections["conclusion"]
        size = "{:.1f} × {:.1f} × {:.1f}".format(*(region.box[1] - region.box[0]))
        figures = f"{size} {region.area_m2:.2f} {region.probability:.2f}"
        assert f"{region.words} {centre_of(region)} {figures}" in page.sections["changes"]
    assert len(regions) == len(kinds) - 1
    assert len(page.all("tr")) == (1 + len(regions) if regions else 0)
    assert len(page.all("img")) == 2
    assert len(page.frames) == 1
    styles = [found.get("style", "") for found in page.all("i")]
    assert all("background:rgb({} {} {})".format(*color) in styles for color in COLORS.values())
    assert not page.all("script")
    assert all(address.startswith(("#", "data:")) for address in page.addresses())
