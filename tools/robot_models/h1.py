"""Unitree H1's MJCF: the MuJoCo Menagerie model with reduced visual meshes, plus two five-finger hands.

Kinematics, masses and limits of the body are Menagerie's; wrist, palm and fingers come from Unitree's `h1_with_hand.urdf`
(`assets/h1_kinematics.csv`), with capsules and boxes in place of the hands' meshes. Coupled finger joints are equality
constraints.
"""

from __future__ import annotations

from pathlib import Path

import fast_simplification
import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from tools.robot_models.common import (
    HAND_FRICTION,
    ROBOT_AFFINITY,
    ROBOT_BIT,
    add_landmarks,
    add_servo,
    damp_servos,
    stiffen_limits,
    tune_joint,
)
from tools.robot_models.csv_tree import LinkRow, add_link, read_rows

SKIN = [0.16, 0.16, 0.18, 1.0]
#: Triangles kept per mesh; the Menagerie meshes have 286 k together, which costs 10 x in rendering on a CPU.
FACES = {"torso_link": 2000, "pelvis": 450}
FACES_DEFAULT = 360
#: Servo stiffness (N m/rad) and force limit (N m) by part of the joint's name; limits are Unitree's.
SERVOS = {
    "hip": (1200.0, 200.0),
    "knee": (500.0, 300.0),
    "ankle": (200.0, 40.0),
    "torso": (1200.0, 200.0),
    "shoulder_pitch": (300.0, 40.0),
    "shoulder_roll": (300.0, 40.0),
    "shoulder_yaw": (150.0, 18.0),
    "elbow": (150.0, 18.0),
    "hand_joint": (40.0, 6.0),
}
#: Finger and thumb servos. One thumb opposes four fingers, so it is the stronger: an object is clamped, not pushed away.
FINGER_SERVO = (1.0, 0.5)
THUMB_SERVO = (10.0, 1.5)


def reduce_mesh(vertices: NDArray[np.float64], faces: NDArray[np.int64], target: int) -> trimesh.Trimesh:
    """Reduces a mesh to about `target` triangles.

    Vertex clustering first joins the many loose shells of a CAD export, quadric decimation then does the rest; the clustering
    grid grows until the target is met.
    """
    points, triangles = vertices.astype(np.float32), faces.astype(np.int32)
    grid_m = 0.004
    while len(triangles) > target and grid_m < 0.05:
        cells, cell_of = np.unique(np.round(points / grid_m).astype(int), axis=0, return_inverse=True)
        cell_of = cell_of.ravel()
        count = np.bincount(cell_of, minlength=len(cells))
        points = np.stack([np.bincount(cell_of, weights=points[:, i]) / count for i in range(3)], axis=1).astype(np.float32)
        triangles = cell_of[triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (a != c)]
        _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
        triangles = triangles[np.sort(first)].astype(np.int32)
        if len(triangles) > target:
            simplified = fast_simplification.simplify(
                points.astype(np.float64), triangles, target_reduction=1.0 - target / len(triangles), agg=9
            )
            points, triangles = simplified[0].astype(np.float32), simplified[1].astype(np.int32)
        grid_m *= 1.35
    return trimesh.Trimesh(points, triangles, process=True)


def _write_meshes(source: Path, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted((source / "assets").glob("*.stl")):
        mesh = trimesh.load(path, force="mesh")
        if not isinstance(mesh, trimesh.Trimesh):
            raise ValueError(f"{path} holds no triangle mesh")
        mesh.merge_vertices(digits_vertex=4)
        reduced = reduce_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), FACES.get(path.stem, FACES_DEFAULT))
        reduced.export(target / path.name)


def _add_hand(spec: mujoco.MjSpec, bodies: dict[str, mujoco.MjsBody], rows: dict[str, LinkRow], side: str) -> None:
    letter = "L" if side == "left" else "R"
    base = bodies[f"{letter}_hand_base_link"]
    contact = {"contype": ROBOT_BIT, "conaffinity": ROBOT_AFFINITY, "friction": list(HAND_FRICTION)}
    base.add_geom(
        name=f"{side}_palm",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.013, 0.045, 0.04],
        pos=[-0.004, -0.088, 0.0],
        rgba=SKIN,
        mass=0.0,
        group=2,
        **contact,
    )

    def finger(link: str, end: tuple[float, ...], radius: float, name: str) -> None:
        bodies[f"{letter}_{link}"].add_geom(
            name=f"{side}_{name}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[radius, 0.0, 0.0],
            fromto=[0.0, 0.0, 0.0, *end],
            rgba=SKIN,
            mass=0.0,
            group=2,
            **contact,
        )

    def tip(link: str) -> tuple[float, ...]:
        x, y, z = rows[f"{letter}_{link}"].com  # a last segment reaches about twice as far as its centre of mass
        return (1.95 * x, 1.95 * y, z)

    for name in ("index", "middle", "ring", "pinky"):
        finger(f"{name}_proximal", rows[f"{letter}_{name}_intermediate"].origin, 0.008, f"{name}_proximal")
        finger(f"{name}_intermediate", tip(f"{name}_intermediate"), 0.0075, f"{name}_tip")
    finger("thumb_proximal", rows[f"{letter}_thumb_intermediate"].origin, 0.009, "thumb_proximal")
    finger("thumb_intermediate", rows[f"{letter}_thumb_distal"].origin, 0.0085, "thumb_middle")
    finger("thumb_distal", tip("thumb_distal"), 0.008, "thumb_tip")
    # x along the fingers, y out of the palm towards the thumb's tip: the closing direction
    base.add_site(
        name=f"{side}_grasp",
        pos=[-0.055, -0.118, 0.0],
        xyaxes=[0.0, -1.0, 0.0, -1.0, 0.0, 0.0],
        size=[0.004, 0.0, 0.0],
        group=4,
    )


def build_h1(menagerie: Path, table: Path, target: Path) -> None:
    """Writes `h1.xml`, its reduced meshes and the licence to `target`.

    Args:
        menagerie: directory `unitree_h1` of MuJoCo Menagerie.
        table: `h1_kinematics.csv`.
        target: output directory.
    """
    _write_meshes(menagerie, target / "meshes")
    (target / "LICENSE").write_bytes((menagerie / "LICENSE").read_bytes())
    spec = mujoco.MjSpec.from_file(str(menagerie / "h1.xml"))
    spec.modelname = "h1"
    spec.meshdir = "meshes"
    spec.modelfiledir = str(target)
    for element in [*spec.lights, *spec.actuators, *spec.keys, *spec.sensors]:
        spec.delete(element)
    for material in spec.materials:
        if material.name == "black":
            material.rgba = [0.17, 0.17, 0.19, 1.0]
    spec.body("pelvis").pos = [0.0, 0.0, 1.044]
    for geom in spec.geoms:  # trunk and legs never collide, see build_common
        geom.contype, geom.conaffinity = 0, 0
        if geom.meshname == "logo_link":  # in front of the reduced chest, which is not exactly flat
            geom.pos = np.asarray(geom.pos) + np.array([0.004, 0.0, 0.0])
    bodies = {body.name: body for body in spec.bodies}
    rows = {
        row.link: row
        for row in read_rows(table, "h1_with_hand.urdf")
        if row.link.startswith(("left_hand", "right_hand", "L_", "R_"))
    }
    coupled = set()
    for row in rows.values():
        bodies[row.link] = add_link(bodies[row.parent], row)
        if row.mimic is not None:
            leader, factor, offset = row.mimic
            coupled.add(row.joint)
            spec.add_equality(
                name=f"couple_{row.joint}",
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=row.joint,
                name2=leader,
                data=np.array([offset, factor] + [0.0] * 10),
            )
    for side in ("left", "right"):
        _add_hand(spec, bodies, rows, side)
        bodies[f"{side}_elbow_link"].add_geom(
            name=f"{side}_forearm",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[0.03, 0.0, 0.0],
            fromto=[0.06, 0.0, -0.018, 0.25, 0.0, -0.018],
            rgba=[0.2, 0.2, 0.2, 0.0],
            mass=0.0,
            group=3,
            contype=ROBOT_BIT,
            conaffinity=ROBOT_AFFINITY,
        )
    for joint in spec.joints:
        if int(joint.type) == int(mujoco.mjtJoint.mjJNT_FREE):
            joint.name = "root"
            continue
        servo = next((value for part, value in SERVOS.items() if part in joint.name), None)
        if servo is None:
            tune_joint(joint, armature=0.001, damping=0.05)
            stiffen_limits(joint)
            if joint.name not in coupled:
                add_servo(spec, joint, *(THUMB_SERVO if "thumb" in joint.name else FINGER_SERVO))
        else:
            armature = 0.02 if "hand" in joint.name else 0.1
            tune_joint(joint, armature, damping=2.0 * float(np.sqrt(servo[0] * armature)))
            add_servo(spec, joint, *servo)
    damp_servos(spec)
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    pitch = np.radians(40.0)  # the head looks down at tables
    spec.body("torso_link").add_camera(
        name="head",
        pos=[0.10848474, 0.0, 0.69317107],
        xyaxes=[0.0, -1.0, 0.0, np.sin(pitch), 0.0, np.cos(pitch)],
        fovy=72.0,
    )
    add_landmarks(spec.body("torso_link"), {"chest": [0.0, 0.0, 0.3], "head": [0.03, 0.0, 0.69]})
    for side in ("left", "right"):  # centre of the sole, under the foot's capsules
        add_landmarks(spec.body(f"{side}_ankle_link"), {f"{side}_sole": [0.0525, 0.0, -0.07]})
    spec.compile()
    text = spec.to_xml()
    (target / "h1.xml").write_text(text, encoding="utf-8")
