"""Builds MJCF bodies from the kinematics tables (`assets/*_kinematics.csv`): one row per link, in the vendors' own frames."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, slots=True)
class LinkRow:
    """One link with the joint that carries it; angles in radians, lengths in metres, masses in kilograms."""

    joint: str
    parent: str
    link: str
    kind: str
    origin: tuple[float, ...]
    rpy: tuple[float, ...]
    axis: tuple[float, ...]
    limits: tuple[float, float] | None
    mass: float
    com: tuple[float, ...]
    inertia: tuple[float, ...]
    mimic: tuple[str, float, float] | None


def _floats(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def read_rows(path: Path, source: str) -> list[LinkRow]:
    """Rows of the table whose `source` column contains the given text, in file order."""
    rows: list[LinkRow] = []
    with path.open(newline="", encoding="utf-8") as handle:
        for record in csv.DictReader(handle):
            if source not in record["source"]:
                continue
            mimic = None
            if record["mimic"]:
                leader, _, rest = record["mimic"].partition("*")
                factor, _, offset = rest.partition("+")
                mimic = (leader, float(factor), float(offset))
            rows.append(
                LinkRow(
                    joint=record["name"],
                    parent=record["parent_link"],
                    link=record["child_link"],
                    kind=record["type"],
                    origin=_floats(record["origin_xyz"]),
                    rpy=_floats(record["origin_rpy"]),
                    axis=_floats(record["axis"]),
                    limits=(float(record["lower"]), float(record["upper"])) if record["lower"] else None,
                    mass=float(record["child_mass"] or 0.0),
                    com=_floats(record["child_com"]),
                    inertia=_floats(record["child_inertia_ixx_ixy_ixz_iyy_iyz_izz"]),
                    mimic=mimic,
                )
            )
    if not rows:
        raise ValueError(f"{path}: no row with source {source!r}")
    return rows


def set_inertia(body: mujoco.MjsBody, row: LinkRow) -> None:
    """Writes mass, centre of mass and the full inertia of a row into a body."""
    ixx, ixy, ixz, iyy, iyz, izz = row.inertia
    body.mass = row.mass
    body.ipos = np.asarray(row.com)
    body.fullinertia = np.asarray([ixx, iyy, izz, ixy, ixz, iyz])
    body.explicitinertial = True


def add_link(parent: mujoco.MjsBody, row: LinkRow) -> mujoco.MjsBody:
    """Adds the row's link, and its hinge when it is revolute, under `parent`."""
    quat = Rotation.from_euler("xyz", row.rpy).as_quat(scalar_first=True)
    body = parent.add_body(name=row.link, pos=list(row.origin), quat=quat)
    if row.mass > 0.0:
        set_inertia(body, row)
    if row.kind == "revolute":
        if row.limits is None:
            raise ValueError(f"joint {row.joint!r} has no limits")
        body.add_joint(name=row.joint, axis=list(row.axis), range=list(row.limits), limited=True)
    return body
