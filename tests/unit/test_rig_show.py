"""The contact sheet of a rig."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np

from cap4d.rig.show import COLUMNS, TILE, contact_sheet, draw, head_camera, label, pictures


def test_sheet_has_a_tile_per_picture(builtin_rig, tmp_path):
    few = replace(
        builtin_rig,
        expression_names=builtin_rig.expression_names[:2],
        expression_basis=builtin_rig.expression_basis[:2],
        expression_range=builtin_rig.expression_range[:2],
        joints_expression=builtin_rig.joints_expression[:2],
        identity_basis=builtin_rig.identity_basis[:1],
        joints_identity=builtin_rig.joints_identity[:1],
    )
    names = [name for name, _ in pictures(few)]
    assert names[:4] == ["front", "three-quarter", "side", "back"]
    assert names[-2:] == list(few.expression_names) and "identity0 +2" in names
    contact_sheet(few, tmp_path / "sheet.png")
    width, height = struct.unpack(">II", (tmp_path / "sheet.png").read_bytes()[16:24])
    assert width == COLUMNS * TILE and height == -(-len(names) // COLUMNS) * (TILE + 11)


def test_the_head_fills_the_picture(builtin_rig):
    picture = draw(builtin_rig, builtin_rig.template)
    rows, columns = np.nonzero((picture < 250).any(-1))
    assert rows.min() > 2 and columns.min() > 2 and columns.max() < TILE - 3  # nothing of the head is cut off
    assert np.ptp(rows) > 0.8 * TILE
    assert head_camera(builtin_rig, 90).position[0] > 0.5  # yaw 90 looks from the person's left


def test_labels_can_be_told_apart():
    picture = np.full((4, 60, 3), 255, np.uint8)
    seen = {label(picture, letter)[:11].tobytes() for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789+-._ "}
    assert len(seen) == 41
    assert label(picture, "much too long a name").shape == (15, 60, 3)
    assert (label(picture, "jaw")[11:] == picture).all()
