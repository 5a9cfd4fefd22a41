"""Offscreen pictures of a world: RGB, metric depth and instance segmentation of one camera at one size.

The OpenGL backend is chosen in `robots.gl`: EGL unless MUJOCO_GL says otherwise, OSMesa where EGL is missing.
Planner images have no shadows, reflections, textures or multisampling (measured on two shared CPU cores: 10 x and 3 x). Paper:
first-person and third-person cameras of DualTHOR. Left out: camera noise and lens distortion.

Camera frame: x right, y down, z forward. Shape letters: H rows, W columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.scene.catalogue import load_catalogue
from sim.scene.surfaces import FLOOR, PLASTER, SURFACES
from sim.world.canvas import shared_canvas
from sim.world.decor import ring_walls, wall_decor
from sim.world.poses import ObjectPoses
from sim.world.scene_state import SceneState
from sim.world.servos import Servos

CAMERAS: Final = ("head", "front", "left", "right", "behind", "top", "overview", "plan")
MAX_SIZE: Final = 1280
#: Height of the segmentation that decides what is visible, pixels, and the fewest pixels that an object shows.
VISIBILITY_SIZE: Final = 112
_LEAST_PIXELS: Final = 6
_MAX_GEOMS: Final = 1500
#: For people: samples of a pixel; what is left of the lights that planners see by; the lamp's strength and place.
_SAMPLES: Final = 8
_HEADLIGHT, _FILL = 0.75, 0.5
_LAMP, _LAMP_ABOVE_M = 0.5, 1.0
#: Half the thickness below which walls cast no shadow: their own would speck them.
_THIN_M: Final = 0.01
#: Greys of black robots: brighter ones are left alone; parts with a larger radius are shells.
_BLACK, _SHELL, _JOINT, _SHELL_M = 0.25, 0.68, 0.3, 0.14
#: A camera of the room that stands in for one that is put somewhere for a picture.
_FREE: Final = "overview"
#: A geom group that is not drawn.
_UNSEEN_GROUP: Final = 5
#: Cameras that go with the robot around it; they stay before the furniture.
_FOLLOWING: Final = ("front", "left", "right", "behind")
_CLOSEST_M: Final = 1.2
_FURNITURE_GAP_M: Final = 0.12
_ROBOT: Final = -2
_NOTHING: Final = -1


@dataclass(frozen=True, slots=True)
class View:
    """One picture with everything that was asked for.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres along the optical axis, or None.
        segmentation: (H, W) int32, index into the scene's objects in their order, -1 for walls, floor and sky, -2 for the
            robot; or None.
        intrinsics: (3, 3) K in pixels.
        camera_in_world: (4, 4) pose of the camera (x right, y down, z forward).
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32] | None
    segmentation: NDArray[np.int32] | None
    intrinsics: NDArray[np.float64]
    camera_in_world: NDArray[np.float64]


def camera_intrinsics(scene: SceneState, camera: str, height: int, width: int) -> NDArray[np.float64]:
    """(3, 3) pinhole matrix in pixels; the field of view is vertical, pixels are square."""
    fovy = float(np.radians(scene.model.cam_fovy[_camera_id(scene, camera)]))
    focal = 0.5 * height / np.tan(fovy / 2.0)
    return np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])


def camera_pose(scene: SceneState, camera: str) -> NDArray[np.float64]:
    """(4, 4) pose of a camera in the world, x right, y down, z forward; one around the robot comes closer before furniture."""
    index, pose = _camera_id(scene, camera), np.eye(4)
    pose[:3, :3] = scene.data.cam_xmat[index].reshape(3, 3) * np.array([1.0, -1.0, -1.0])
    pose[:3, 3] = _unobstructed(scene, index) if camera in _FOLLOWING else scene.data.cam_xpos[index]
    return pose


def _unobstructed(scene: SceneState, camera: int) -> NDArray[np.float64]:
    """(3,) place of a camera around the robot, drawn in along its sight to before the furniture.

    Walls are looked through from outside. Furniture that is close to the robot is not avoided: the picture would show little
    of the robot but its back.
    """
    model, data = scene.model, scene.data
    target, place = data.xpos[int(model.cam_bodyid[camera])], data.cam_xpos[camera]
    away = place - target
    length = float(np.linalg.norm(away))
    hit, start = np.zeros(1, dtype=np.int32), _CLOSEST_M
    furniture = np.array([1, 1, 0, 0, 0, 0], dtype=np.uint8)  # the robot's own geoms are in other groups
    while start < length + _FURNITURE_GAP_M:
        distance = mujoco.mj_ray(model, data, target + start * away / length, away / length, furniture, 1, -1, hit)
        if distance < 0.0:
            break
        start += distance + 0.01
        fixed = int(model.body_weldid[model.geom_bodyid[hit[0]]]) == 0  # what can move may be looked through
        if fixed and int(model.geom_type[hit[0]]) != int(mujoco.mjtGeom.mjGEOM_PLANE):
            return target + away / length * min(start - 0.01 - _FURNITURE_GAP_M, length)
    return place.copy()


def _camera_id(scene: SceneState, camera: str) -> int:
    name = scene.robot.head_camera if camera == "head" and scene.robot is not None else camera
    known = isinstance(name, str)  # MuJoCo ends the process on anything else
    index = mujoco.mj_name2id(scene.model, int(mujoco.mjtObj.mjOBJ_CAMERA), name) if known else -1
    if index < 0:
        names = ", ".join(str(scene.model.camera(i).name) for i in range(scene.model.ncam))
        raise ValueError(f"unknown camera {camera!r}; allowed: {names}")
    return index


def greys(scene: SceneState) -> dict[int, float]:
    """Greys for the meshes of a robot that is black all over, by geom: large shells are light, what joins them is dark."""
    model, mesh = scene.model, int(mujoco.mjtGeom.mjGEOM_MESH)
    found: dict[int, float] = {}
    for geom in range(model.ngeom):
        colour = model.mat_rgba[model.geom_matid[geom]] if model.geom_matid[geom] >= 0 else model.geom_rgba[geom]
        mine = int(model.geom_bodyid[geom]) in scene.robot_bodies and int(model.geom_type[geom]) == mesh
        if mine and float(colour[:3].max()) < _BLACK:
            found[geom] = _SHELL if float(model.geom_rbound[geom]) > _SHELL_M else _JOINT
    return found


def surfaces(model: mujoco.MjModel) -> dict[int, int]:
    """Materials for people, by geom: the floor's, the walls', and those of the catalogue's colours."""
    materials = {str(model.material(index).name): index for index in range(model.nmat)}
    colors = {name: np.array(rgba[:3], dtype=np.float32) for name, rgba in load_catalogue().colors.items() if name in SURFACES}
    found = {int(model.geom("floor").id): materials[FLOOR]}
    for geom in range(model.ngeom):
        if model.geom(geom).name.startswith("wall_"):
            found[geom] = materials[PLASTER]
        elif model.geom_matid[geom] < 0:
            same = (name for name, rgb in colors.items() if np.array_equal(model.geom_rgba[geom, :3], rgb))
            if (name := next(same, None)) is not None:
                found[geom] = materials[SURFACES[name]]
    return found


class Renderer:
    """Draws a world at one size.

    Args:
        scene: what is drawn; it may advance between calls.
        height: rows, at most 1280.
        width: columns, at most 1280.
        pretty: a lamp at the ceiling that casts shadows, surfaces of wood, fabric and plaster, skirting boards, windows,
            and smooth edges, for people; planners get plain pictures.

    Raises:
        ValueError: on a size outside 1..1280.
        RenderingError: when no OpenGL context can be made.
    """

    def __init__(self, scene: SceneState, height: int = 112, width: int = 112, *, pretty: bool = False) -> None:
        if not (1 <= height <= MAX_SIZE and 1 <= width <= MAX_SIZE):
            raise ValueError(f"image size {height} x {width} outside 1..{MAX_SIZE}")
        self._scene, self._height, self._width, self._pretty = scene, height, width, pretty
        self._canvas = shared_canvas(scene.model, scene.name, height, width, _SAMPLES if pretty else 0)
        self._drawn = mujoco.MjvScene(scene.model, maxgeom=_MAX_GEOMS)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[[0, 1, 2]] = 1
        self._option.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = int(mujoco.mjtCamera.mjCAMERA_FIXED)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._drawn.flags[int(flag)] = int(pretty)
        self._shades = greys(scene) if pretty else {}
        self._surfaces = surfaces(scene.model) if pretty else {}
        self._decor = wall_decor(scene) if pretty else []
        self._rings = ring_walls(scene) if pretty else {}
        self._planes = np.flatnonzero(scene.model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))
        robot = np.isin(scene.model.geom_bodyid, list(scene.robot_bodies))
        labels = np.where(robot, _ROBOT, scene.object_of_geom).astype(np.int32)
        self._labels = np.append(labels, _NOTHING)  # the last entry is what geom -1, the sky, maps to

    def _out_of_view(self, camera: int) -> NDArray[np.bool_]:
        """(ngeom,) geoms whose bounding spheres lie behind a camera or beside its view; planes are never left out."""
        model, data = self._scene.model, self._scene.data
        axes = data.cam_xmat[camera].reshape(3, 3)
        offsets = (data.geom_xpos - data.cam_xpos[camera]) @ axes  # right, up, back
        radius = model.geom_rbound
        half = np.radians(float(model.cam_fovy[camera])) / 2.0
        out = offsets[:, 2] > radius
        for lateral, share in ((offsets[:, 1], 1.0), (offsets[:, 0], self._width / self._height)):
            edge = np.arctan(np.tan(half) * share)
            out |= np.abs(lateral) * np.cos(edge) + offsets[:, 2] * np.sin(edge) > radius
        return out & (radius > 0.0)

    def _seen_from_behind(self, place: NDArray[np.float64]) -> NDArray[np.int64]:
        """Walls, floor or ceiling that a camera outside the room looks through; where there are none the sky is not seen."""
        data, planes = self._scene.data, self._planes
        normals = data.geom_xmat[planes].reshape(-1, 3, 3)[:, :, 2]
        return planes[np.einsum("pi,pi->p", place - data.geom_xpos[planes], normals) < 0.0]

    def _look(self, camera: str) -> NDArray[np.float64]:
        """Brings the scene up to date for a camera; its (4, 4) pose."""
        scene = self._scene
        index = self._camera.fixedcamid = _camera_id(scene, camera)
        mujoco.mj_camlight(scene.model, scene.data)
        place, pose = scene.data.cam_xpos[index].copy(), camera_pose(scene, camera)
        scene.data.cam_xpos[index] = pose[:3, 3]
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        groups = scene.model.geom_group
        kept = groups.copy()
        if not self._pretty:  # shadows come from what is not in view, too
            groups[self._out_of_view(index)] = _UNSEEN_GROUP
        outside = self._seen_from_behind(pose[:3, 3])
        groups[outside] = _UNSEEN_GROUP
        plain = scene.model.geom_matid.copy()
        scene.model.geom_matid[list(self._surfaces)] = list(self._surfaces.values())
        self._drawn.flags[int(mujoco.mjtRndFlag.mjRND_SKYBOX)] = int(len(outside) > 0)
        mujoco.mjv_updateScene(scene.model, scene.data, self._option, None, self._camera, everything, self._drawn)
        groups[:], scene.model.geom_matid[:] = kept, plain
        scene.data.cam_xpos[index] = place
        if self._pretty:
            self._add_decor(set(outside.tolist()))
            self._round()
            self._light()
        return pose

    def _add_decor(self, outside: set[int]) -> None:
        """What hangs on the walls that are seen."""
        data = self._scene.data
        for one in self._decor:
            if one.wall in outside:
                continue
            turn = data.geom_xmat[one.wall].reshape(3, 3)
            board = self._add_box(one.size, data.geom_xpos[one.wall] + turn @ one.centre, turn, np.array(one.rgba))
            if board is not None:
                board.segid = -1

    def _add_box(
        self, half: NDArray[np.float64], place: NDArray[np.float64], turn: NDArray[np.float64], rgba: NDArray[np.float64]
    ) -> mujoco.MjvGeom | None:
        """One more box in the picture, None when it is full."""
        if self._drawn.ngeom == _MAX_GEOMS:
            return None
        box = self._drawn.geoms[self._drawn.ngeom]
        self._drawn.ngeom += 1
        mujoco.mjv_initGeom(box, int(mujoco.mjtGeom.mjGEOM_BOX), half, place, turn.ravel(), rgba.astype(np.float32))
        return box

    def _round(self) -> None:
        """Draws bowls and pots with 24 walls in place of the 8 that are touched."""
        for wall in self._drawn.geoms[: self._drawn.ngeom]:
            if wall.objtype != int(mujoco.mjtObj.mjOBJ_GEOM) or wall.objid not in self._rings:
                continue
            radius, axis = self._rings[wall.objid], wall.mat[:, 2]
            wall.size[1] = (radius + wall.size[0]) * np.tan(np.pi / 24.0)
            middle = wall.pos - radius * wall.mat[:, 0]
            for angle in (-np.pi / 12.0, np.pi / 12.0):
                out = np.cos(angle) * wall.mat[:, 0] + np.sin(angle) * wall.mat[:, 1]
                turn = np.column_stack([out, np.cross(axis, out), axis]).astype(float)
                piece = self._add_box(wall.size.astype(float), (middle + radius * out).astype(float), turn, wall.rgba)
                if piece is not None:
                    piece.objtype, piece.objid, piece.segid, piece.matid = wall.objtype, wall.objid, wall.segid, wall.matid

    def _light(self) -> None:
        """A lamp over the middle of the ceiling that alone casts shadows, and little light from everywhere."""
        ceiling = self._scene.data.geom("ceiling")
        for geom in self._drawn.geoms[: self._drawn.ngeom]:
            if geom.objtype != int(mujoco.mjtObj.mjOBJ_GEOM):
                continue
            thin = geom.type == int(mujoco.mjtGeom.mjGEOM_BOX) and geom.size.min() < _THIN_M
            if thin or geom.objid == ceiling.id:
                geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)  # so it casts no shadow
            if geom.objid in self._shades:
                geom.rgba[:3] = self._shades[geom.objid]
        for light in self._drawn.lights[: self._drawn.nlight]:
            light.castshadow = 0
            share = _HEADLIGHT if light.headlight else _FILL
            light.ambient[:], light.diffuse[:] = light.ambient * share, light.diffuse * share
        lamp = self._drawn.lights[self._drawn.nlight]
        self._drawn.nlight += 1
        lamp.id, lamp.headlight, lamp.castshadow, lamp.texid = -1, 0, 1, -1
        lamp.type = int(mujoco.mjtLightType.mjLIGHT_SPOT)
        lamp.pos[:], lamp.dir[:] = ceiling.xpos + (0.0, 0.0, _LAMP_ABOVE_M), (0.0, 0.0, -1.0)
        lamp.attenuation[:], lamp.cutoff, lamp.exponent = (1.0, 0.0, 0.0), 80.0, 0.0
        lamp.bulbradius, lamp.intensity, lamp.range = 0.05, 0.0, 20.0
        lamp.ambient[:], lamp.diffuse[:], lamp.specular[:] = 0.0, _LAMP, 0.1

    def labels(self, camera: str = "head") -> NDArray[np.int32]:
        """(H, W) segmentation of one camera as in `View`, without drawing its colours.

        Raises:
            ValueError: on an unknown camera.
        """
        self._look(camera)
        return self._labels[self._canvas.depth_and_geoms(self._scene.model, self._drawn)[1]]

    def view(self, camera: str = "head", *, depth: bool = False, segmentation: bool = False) -> View:
        """Draws one camera as the world is now.

        Raises:
            ValueError: on an unknown camera.
        """
        scene, pose = self._scene, self._look(camera)
        distances = labels = None
        if depth or segmentation:
            metres, geoms = self._canvas.depth_and_geoms(scene.model, self._drawn)
            distances = metres if depth else None
            labels = self._labels[geoms] if segmentation else None
        return View(
            self._canvas.colors(self._drawn),
            distances,
            labels,
            camera_intrinsics(scene, camera, self._height, self._width),
            pose,
        )


class Cameras:
    """The cameras of a running scene; OpenGL contexts are shared by equal scenes.

    Args:
        scene: the running scene.
        poses, servos: how far objects are from the robot.
    """

    def __init__(self, scene: SceneState, poses: ObjectPoses, servos: Servos) -> None:
        self._scene, self._poses, self._servos = scene, poses, servos
        self._renderers: dict[tuple[int, int, bool], Renderer] = {}

    def render(
        self,
        camera: str = "head",
        height: int = 112,
        width: int = 112,
        *,
        depth: bool = False,
        segmentation: bool = False,
        pretty: bool = False,
    ) -> View:
        """Draws a camera of `CAMERAS`; `pretty` as in `Renderer`."""
        return self._renderer(height, width, pretty).view(camera, depth=depth, segmentation=segmentation)

    def render_from(
        self, pose: NDArray[np.float64], fovy_deg: float, height: int = 112, width: int = 112, *, pretty: bool = False
    ) -> NDArray[np.uint8]:
        """(H, W, 3) picture of a camera that stands anywhere.

        Args:
            pose: (4, 4) of the camera in the world, x right, y down, z forward.
            fovy_deg: its vertical field of view.
            height: rows.
            width: columns.
            pretty: as in `Renderer`.
        """
        model, data, index = self._scene.model, self._scene.data, _camera_id(self._scene, _FREE)
        owners = ((model, "cam_pos"), (model, "cam_quat"), (model, "cam_fovy"), (data, "cam_xpos"), (data, "cam_xmat"))
        before = [getattr(owner, name)[index].copy() for owner, name in owners]
        rotation, quaternion = pose[:3, :3] * np.array([1.0, -1.0, -1.0]), np.empty(4)
        mujoco.mju_mat2Quat(quaternion, rotation.ravel())
        values = (pose[:3, 3], quaternion, fovy_deg, pose[:3, 3], rotation.ravel())  # MuJoCo leaves cameras of the room alone
        try:
            for (owner, name), value in zip(owners, values, strict=True):
                getattr(owner, name)[index] = value
            return self._renderer(height, width, pretty).view(_FREE).rgb
        finally:
            for (owner, name), value in zip(owners, before, strict=True):
                getattr(owner, name)[index] = value

    def labels(self, camera: str = "head", height: int = 112, width: int = 112) -> NDArray[np.int32]:
        """(H, W) segmentation of a camera as in `View`, for less than half of what a picture with it costs."""
        return self._renderer(height, width).labels(camera)

    def visible_objects(self, aspect: float = 1.0, *, range_m: float = 8.0) -> dict[str, int]:
        """Objects in the head camera's view and the number of pixels each covers, at least `_LEAST_PIXELS`.

        They are counted at one size, so that what is visible does not depend on the size of anybody's picture.

        Args:
            aspect: width of the view over its height.
            range_m: farthest horizontal distance from the base.
        """
        segmentation = self.labels("head", VISIBILITY_SIZE, round(aspect * VISIBILITY_SIZE))
        names = list(self._scene.objects)
        labels, counts = np.unique(segmentation[segmentation >= 0], return_counts=True)
        found = {names[int(i)]: int(count) for i, count in zip(labels, counts, strict=True) if count >= _LEAST_PIXELS}
        return {name: n for name, n in found.items() if self._servos.distance_to(self._poses.bounds(name)) <= range_m}

    def close(self) -> None:
        """Drops the renderers; the shared OpenGL contexts stay with the process, and drawing goes on when asked again."""
        self._renderers.clear()

    def _renderer(self, height: int, width: int, pretty: bool = False) -> Renderer:
        key = height, width, pretty
        if key not in self._renderers:
            self._renderers[key] = Renderer(self._scene, height, width, pretty=pretty)
        return self._renderers[key]
