"""Robot descriptions: the built-in ones are consistent with their MJCF, and bad files are refused with the offending value."""

from pathlib import Path

import mujoco
import pytest
import yaml

from configs.validate import ConfigError
from interface.bodies import KEY_BODIES, SIDES
from robots.spec import available_robots, load_robot

SPECS = Path(load_robot("h1").mjcf_path).parents[2] / "specs"


def test_built_in_robots():
    assert available_robots() == ("h1", "x1")


@pytest.mark.parametrize("name", available_robots())
def test_description_matches_the_mjcf(name):
    spec = load_robot(name)
    model = mujoco.MjModel.from_xml_path(str(spec.mjcf_path))
    joints = tuple(model.joint(i).name for i in range(model.njnt) if int(model.jnt_type[i]) != int(mujoco.mjtJoint.mjJNT_FREE))
    assert spec.joints == joints
    assert int(model.jnt_type[0]) == int(mujoco.mjtJoint.mjJNT_FREE) and model.joint(0).id == 0
    names = {model.body(i).name for i in range(model.nbody)} | {model.site(i).name for i in range(model.nsite)}
    assert set(spec.key_bodies) == set(KEY_BODIES)
    assert set(spec.key_bodies.values()) <= names
    assert spec.root_body == model.body(1).name
    assert model.camera(spec.head_camera).id >= 0
    for side in SIDES:
        arm = spec.arms[side]
        assert arm.grasp_site in names
        for group in arm.finger_groups:
            assert group and all(model.geom(geom).contype[0] for geom in group)
        for joint in (*arm.joints, *arm.hand_joints):
            assert model.actuator(joint).id >= 0  # a position servo of the same name
        pairs = [*zip(arm.hand_joints, arm.hand_open, strict=True), *zip(arm.hand_joints, arm.hand_closed, strict=True)]
        for joint, value in [*pairs, *zip(arm.joints, arm.rest, strict=True), *zip(arm.joints, arm.carry, strict=True)]:
            low, high = model.joint(joint).range
            assert low - 1e-9 <= value <= high + 1e-9, (joint, value)
    low, high = spec.pelvis_height_range_m
    assert low < spec.standing_pelvis_height_m <= high + 1e-9


def _write(tmp_path: Path, **changes: object) -> str:
    values = yaml.safe_load((SPECS / "x1.yaml").read_text(encoding="utf-8"))
    values["mjcf"] = str(load_robot("x1").mjcf_path)
    values.update(changes)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return str(path)


def test_a_robot_of_ones_own(tmp_path):
    spec = load_robot(_write(tmp_path, name="mine", footprint_radius_m=0.5))
    assert spec.name == "mine" and spec.footprint_radius_m == 0.5
    assert spec.arms["left"] == load_robot("x1").arms["left"]


def test_another_mjcf(tmp_path):
    other = tmp_path / "other.xml"
    other.write_text(load_robot("x1").mjcf_path.read_text(encoding="utf-8"), encoding="utf-8")
    assert load_robot("x1", str(other)).mjcf_path == other.resolve()
    with pytest.raises(ConfigError, match=r"missing\.xml"):
        load_robot("x1", str(tmp_path / "missing.xml"))


def test_unknown_robot():
    with pytest.raises(ConfigError, match=r"'g1': no such robot; allowed: h1, x1"):
        load_robot("g1")


def test_missing_mjcf(tmp_path):
    with pytest.raises(ConfigError, match=r"mjcf 'nowhere.xml' not found"):
        load_robot(_write(tmp_path, mjcf="nowhere.xml"))


def test_unknown_joint(tmp_path):
    with pytest.raises(ConfigError, match=r"'knee_of_nobody'"):
        load_robot(_write(tmp_path, waist_joints=["knee_of_nobody"]))


def test_unknown_key(tmp_path):
    with pytest.raises(ConfigError, match=r"wings"):
        load_robot(_write(tmp_path, wings=2))


def test_wrong_arms(tmp_path):
    arms = yaml.safe_load((SPECS / "x1.yaml").read_text(encoding="utf-8"))["arms"]
    with pytest.raises(ConfigError, match=r"\['left'\]"):
        load_robot(_write(tmp_path, arms={"left": arms["left"]}))
    arms["left"]["rest"] = [0.0]
    with pytest.raises(ConfigError, match="one value per joint of left_grasp"):
        load_robot(_write(tmp_path, arms=arms, name="other"))


def test_missing_key_bodies(tmp_path):
    with pytest.raises(ConfigError, match=r"'torso'"):
        load_robot(_write(tmp_path, key_bodies={"head": "head"}))


def test_empty_height_range(tmp_path):
    with pytest.raises(ConfigError, match=r"\(0.6, 0.4\)"):
        load_robot(_write(tmp_path, pelvis_height_range_m=[0.6, 0.4]))


def test_a_list_is_no_description(tmp_path):
    path = tmp_path / "list.yaml"
    path.write_text("- 1\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="expected a mapping"):
        load_robot(str(path))
