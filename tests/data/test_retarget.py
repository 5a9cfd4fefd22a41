import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from configs.schema.data import GateConfig
from data.filter import admit, apply_phc_list, automatic_rule, gate, phc_list
from data.generator import generate_clip
from data.metrics import (
    Metrics,
    angle_deg,
    balance_cm,
    evaluate,
    evaluate_joints,
    limit_violation_pct,
    pa_mpjpe_cm,
    saturation_pct,
    skate_cm_s,
)
from data.motion import N_FEATURES, decode_key_bodies, heading_to_world
from data.omomo import find_demo_clips, load_mocap, load_omomo
from data.retarget import MAX_JOINT_VELOCITY, Retargeted, Retargeter
from data.retarget_report import PHYSICS, measure, table
from data.retarget_report import main as report
from data.skeleton import Caption, HumanMotion, index
from robots.leg_ik import crouch
from robots.spec import load_robot

ROBOTS = ("h1", "x1")
#: walk, side-step, reach low with both, wave
NUMBERS = (0, 3, 8, 16)


@pytest.fixture(scope="module")
def retargeters() -> dict[str, Retargeter]:
    return {name: Retargeter(load_robot(name)) for name in ROBOTS}


@pytest.fixture(scope="module")
def results(retargeters: dict[str, Retargeter]) -> dict[tuple[str, int], Retargeted]:
    return {(name, n): retargeters[name](generate_clip(0, n)) for name in ROBOTS for n in NUMBERS}


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("number", NUMBERS)
def test_follows_the_human(
    retargeters: dict[str, Retargeter], results: dict[tuple[str, int], Retargeted], robot: str, number: int
) -> None:
    metrics = evaluate(retargeters[robot], results[robot, number])
    assert metrics.hand_cm < (1.5 if robot == "x1" else 1.0)
    assert metrics.foot_cm < 1.0
    assert metrics.arm_deg < 8.0
    assert metrics.leg_deg < 20.0
    assert metrics.skate_cm_s < 6.0
    assert metrics.penetration_cm < 0.5
    assert metrics.limit_pct == 0.0
    assert metrics.velocity_pct == 0.0


@pytest.mark.parametrize("robot", ROBOTS)
def test_features_match_the_joints(
    retargeters: dict[str, Retargeter], results: dict[tuple[str, int], Retargeted], robot: str
) -> None:
    motion = results[robot, 0].motion
    assert motion.root_pose is not None
    assert motion.joint_positions is not None
    assert motion.features.shape == (len(motion.root_pose), N_FEATURES)
    keys = heading_to_world(decode_key_bodies(motion.features), motion.root_pose)
    for t in (0, len(keys) // 2, len(keys) - 1):
        truth = retargeters[robot].robot.key_body_positions(motion.root_pose[t], motion.joint_positions[t])
        np.testing.assert_allclose(keys[t], truth, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(motion.root_pose[:, 3:], axis=1), 1.0, atol=1e-9)
    assert np.abs(np.diff(motion.joint_positions, axis=0)).max() * motion.fps < 30.0  # hands included
    assert motion.captions


def test_velocity_is_bounded_for_a_jumping_input(retargeters: dict[str, Retargeter]) -> None:
    still, raised = generate_clip(0, 6), generate_clip(0, 8)
    joints = np.concatenate([still.joints[:10], raised.joints[30:40] - raised.joints[30, 0] * [1, 1, 0]])
    result = retargeters["h1"](HumanMotion("jump", joints, 20.0, (Caption("x", 0.2, 0.4),)))
    assert result.motion.joint_positions is not None
    arm = retargeters["h1"].robot.indices(load_robot("h1").arms["left"].joints)
    assert np.abs(np.diff(result.motion.joint_positions[:, arm], axis=0)).max() * 20.0 <= MAX_JOINT_VELOCITY
    assert result.motion.captions == ("x",)


def test_other_rates_are_resampled(retargeters: dict[str, Retargeter]) -> None:
    clip = generate_clip(0, 6)
    fast = HumanMotion("a", np.repeat(clip.joints[:20], 2, axis=0), 40.0, clip.captions)
    assert len(retargeters["x1"](fast).motion.features) == 20


def test_iterations_are_checked() -> None:
    with pytest.raises(ValueError, match="iterations 0"):
        Retargeter(load_robot("h1"), 0)


def test_angle() -> None:
    assert angle_deg(np.array([1.0, 0, 0]), np.array([0, 2.0, 0])) == pytest.approx(90.0)
    assert angle_deg(np.array([1.0, 0, 0]), np.array([1.0, 1.0, 0])) == pytest.approx(45.0)


def test_skate_is_the_speed_in_contact() -> None:
    places = np.zeros((5, 2, 3))
    places[:, 0, 0] = np.arange(5) * 0.01  # 1 cm per frame at 20 fps
    contact = np.zeros((5, 2), dtype=bool)
    assert skate_cm_s(places, contact, 20.0) == 0.0
    contact[:, 0] = True
    assert skate_cm_s(places, contact, 20.0) == pytest.approx(20.0)
    contact[:, 1] = True
    assert skate_cm_s(places, contact, 20.0) == pytest.approx(10.0)


def test_limits_and_saturation() -> None:
    lower, upper = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    q = np.array([[0.0, 1.2], [0.995, 0.0]])
    assert limit_violation_pct(q, lower, upper) == 25.0
    assert saturation_pct(q, lower, upper) == 50.0
    assert limit_violation_pct(np.array([[-1.25, 1.25]]), lower, upper, 0.25) == 0.0
    assert limit_violation_pct(np.array([[-1.5, 1.5]]), lower, upper, 0.25) == 100.0


#: The ends of a cross along the axes.
CROSS = np.concatenate([np.eye(3), -np.eye(3)])
TURN = Rotation.from_euler("xyz", [0.4, -0.8, 1.9]).as_matrix()


@pytest.mark.parametrize(
    ("stretch", "left_over_m"),
    [
        ((2.0, 2.0, 2.0), 0.0),
        ((2.0, 2.0, 2.6), (0.2 + 0.2 + 0.4) / 3),  # best at 2.2 times the size
        ((-1.0, 2.0, 3.0), (7 / 3 + 2 / 3 + 5 / 3) / 3),  # a mirrored arm cannot be turned into place; best at 4/3
    ],
)
def test_pa_mpjpe_is_what_the_best_similarity_transform_leaves(stretch: tuple[float, ...], left_over_m: float) -> None:
    stretched = CROSS * stretch
    points = np.stack([CROSS, 0.5 * CROSS @ TURN + [3.0, -2.0, 1.0]])
    reference = np.stack([stretched @ TURN - [1.0, 2.0, 3.0], stretched])
    assert pa_mpjpe_cm(points, reference) == pytest.approx(100.0 * left_over_m, abs=1e-6)


def test_pa_mpjpe_against_scipys_rotations() -> None:
    points, reference = np.random.default_rng(0).normal(size=(2, 20, 12, 3)) + 5.0
    errors: list[float] = []
    for a, b in zip(points, reference, strict=True):
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        turned = Rotation.align_vectors(b, a)[0].apply(a)
        errors += np.linalg.norm((turned * b).sum() / (turned * turned).sum() * turned - b, axis=1).tolist()
    assert pa_mpjpe_cm(points, reference) == pytest.approx(100.0 * np.mean(errors))


def test_balance_is_the_mean_margin_of_every_fourth_frame_of_slow_double_support() -> None:
    margin_is_height = SimpleNamespace(robot=SimpleNamespace(balance_margin=lambda pose, q: pose[2]))
    retargeter = cast(Retargeter, margin_is_height)
    root, q, contact = np.zeros((12, 7)), np.zeros((12, 1)), np.ones((12, 2), dtype=bool)
    root[[1, 6, 11], 2] = 0.25, 0.5, -0.125
    contact[2, 1] = False
    root[7:, 0] = 0.006  # 0.12 m/s on the way to frame 7
    # The first frame has no speed yet: slow are 1, 3, 4, 5, 6, 8, 9, 10, 11.
    assert balance_cm(retargeter, root, q, contact) == pytest.approx(100.0 * (0.25 + 0.5 - 0.125) / 3)
    assert np.isnan(balance_cm(retargeter, root, q, np.tile([True, False], (12, 1))))


Array = NDArray[np.float64]


def standing(retargeter: Retargeter, depths_m: list[float]) -> tuple[Array, Array]:
    """Root poses and joints of a robot that stands, its soles this much below the floor."""
    posture = crouch(retargeter.robot, 0.95, lean_rad=0.0)
    root = np.tile([0.0, 0.0, posture.pelvis_height_m, 1.0, 0.0, 0.0, 0.0], (len(depths_m), 1))
    soles = retargeter.robot.frames(root[0], posture.q, ("left_sole", "right_sole"))
    root[:, 2] -= soles[:, 2, 3].min() + np.array(depths_m)
    return root, np.tile(posture.q, (len(depths_m), 1))


def copying(retargeter: Retargeter, root: Array, q: Array) -> HumanMotion:
    """A human whose limbs are where the robot's are, with toes on the floor."""
    joints = np.zeros((len(root), 22, 3))
    points = retargeter.measured_joints(root, q).points
    for number, name in enumerate(("hip", "knee", "ankle", "shoulder", "elbow", "wrist")):
        joints[:, [index(f"left_{name}"), index(f"right_{name}")]] = points[:, 2 * number : 2 * number + 2]
    return HumanMotion("copy", joints, 20.0)


def test_floor_metrics_of_a_robot_that_stands_at_known_heights(retargeters: dict[str, Retargeter]) -> None:
    retargeter = retargeters["h1"]
    root, q = standing(retargeter, [0.0, 0.03, 0.005, 0.02, -0.01, -0.03, -0.05, -0.03])
    contact = np.ones((8, 2), dtype=bool)
    contact[5] = [False, True]
    contact[7] = False
    metrics = evaluate_joints(retargeter, root, q, copying(retargeter, root, q), contact)
    assert metrics.penetration_cm == pytest.approx((3.0 + 0.5 + 2.0) / 8, abs=1e-4)
    assert metrics.penetration_max_cm == pytest.approx(3.0, abs=1e-4)
    assert metrics.penetration_pct == 25.0
    assert metrics.float_pct == 25.0  # too high, in contact: 5 and 6
    assert metrics.lowest_pelvis == pytest.approx(root[1, 2] / load_robot("h1").standing_pelvis_height_m)
    assert metrics.frames == 8


def test_skating_metrics_of_a_robot_that_slides(retargeters: dict[str, Retargeter]) -> None:
    retargeter = retargeters["h1"]
    root, q = standing(retargeter, [0.0] * 6)
    root[:, 1] = [0.0, 0.01, 0.02, 0.03, 0.5, 0.5]
    contact = np.array([[True, True]] * 4 + [[False, False]] * 2)
    human = copying(retargeter, root, q)
    human.joints[:, [index("left_foot"), index("right_foot")], 0] = 0.005 * np.arange(6)[:, None]
    metrics = evaluate_joints(retargeter, root, q, human, contact)
    assert metrics.skate_cm_s == pytest.approx(20.0)
    assert metrics.human_skate_cm_s == pytest.approx(10.0)


def test_joint_metrics_are_of_the_body_and_not_of_the_hands(retargeters: dict[str, Retargeter]) -> None:
    retargeter = retargeters["h1"]
    spec, robot = retargeter.spec, retargeter.robot
    body = [*spec.leg_joints, *spec.waist_joints, *spec.arms["left"].joints, *spec.arms["right"].joints]
    elbow, other = robot.indices((spec.arms["left"].joints[3], spec.arms["right"].joints[3]))
    root, q = standing(retargeter, [0.0] * 6)
    path = [0.0, MAX_JOINT_VELOCITY / 20.0, 0.0, 0.5, 0.5, 0.375]
    q[:, elbow] = path
    q[:, other] = robot.upper[other] + 0.25
    q[:, robot.indices((spec.arms["left"].hand_joints[0],))] = np.array([[0.0], [5.0]] * 3)
    metrics = evaluate_joints(retargeter, root, q, copying(retargeter, root, q), np.ones((6, 2), dtype=bool))
    assert metrics.limit_pct == pytest.approx(100.0 / len(body))
    assert metrics.velocity_pct == 20.0  # 0.5 rad in a twentieth of a second, but not the limit itself, twice
    assert metrics.jump_pct == 60.0
    thirds = [d - 3 * c + 3 * b - a for a, b, c, d in zip(path, path[1:], path[2:], path[3:], strict=False)]
    assert metrics.jerk_rad_s3 == pytest.approx(sum(map(abs, thirds)) / (3 * len(body)) * 20.0**3)


def test_limb_metrics_of_a_human_that_the_robot_copies(retargeters: dict[str, Retargeter]) -> None:
    retargeter = retargeters["h1"]
    root, q = standing(retargeter, [0.0] * 4)
    human, contact = copying(retargeter, root, q), np.ones((4, 2), dtype=bool)
    alike = evaluate_joints(retargeter, root, q, human, contact)
    assert (alike.arm_deg, alike.leg_deg, alike.pa_mpjpe_cm) == pytest.approx((0.0, 0.0, 0.0), abs=1e-5)
    bent = dataclasses.replace(human, joints=human.joints.copy())
    for middle, end in (("elbow", "wrist"), ("knee", "ankle")):
        at, to = index(f"left_{middle}"), index(f"left_{end}")
        bent.joints[:, to] = human.joints[:, at] + np.cross(human.joints[:, to] - human.joints[:, at], [0.1, 0.2, 0.3])
    angles = evaluate_joints(retargeter, root, q, bent, contact)
    assert (angles.arm_deg, angles.leg_deg) == pytest.approx((90.0 / 4, 90.0 / 4))
    assert angles.pa_mpjpe_cm > 1.0


def test_errors_are_distances_to_the_targets(
    retargeters: dict[str, Retargeter], results: dict[tuple[str, int], Retargeted]
) -> None:
    retargeter = retargeters["h1"]
    root, q = standing(retargeter, [0.0] * 5)
    places = retargeter.measured_joints(root, q)
    away = np.linspace(0.0, 1.0, 5)[:, None, None] * np.ones((5, 2, 1))
    targets = dataclasses.replace(
        results["h1", 16].targets,
        soles=places.soles + away * [0.03, 0.0, -0.04],
        arms=places.arms + away[..., None] * [0.0, 0.03, 0.04],  # each of two bones
    )
    human = copying(retargeter, root, q)
    metrics = evaluate_joints(retargeter, root, q, human, np.ones((5, 2), dtype=bool), targets)
    assert (metrics.foot_cm, metrics.hand_cm) == pytest.approx((2.5, 5.0))
    assert (metrics.foot_p95_cm, metrics.hand_p95_cm) == pytest.approx((5.0, 10.0))


def test_self_contact_counts_from_beyond_a_centimetre(
    retargeters: dict[str, Retargeter], monkeypatch: pytest.MonkeyPatch
) -> None:
    retargeter = retargeters["h1"]
    depths = iter([0.0, 0.01, 0.02, 0.03])
    monkeypatch.setitem(vars(retargeter), "self_contact", SimpleNamespace(depth_m=lambda pose, joints: next(depths)))
    root, q = standing(retargeter, [0.0] * 4)
    metrics = evaluate_joints(retargeter, root, q, copying(retargeter, root, q), np.ones((4, 2), dtype=bool))
    assert (metrics.self_pct, metrics.self_max_cm) == (50.0, 3.0)


@pytest.mark.parametrize(("frames", "share"), [(1, 0.0), (2, 100.0)])
def test_speed_takes_two_frames(retargeters: dict[str, Retargeter], frames: int, share: float) -> None:
    retargeter = retargeters["h1"]
    root, q = standing(retargeter, [0.0] * frames)
    q[-1, retargeter.robot.indices((retargeter.spec.arms["left"].joints[0],))] += 1.0
    metrics = evaluate_joints(retargeter, root, q, copying(retargeter, root, q), np.ones((frames, 2), dtype=bool))
    assert (metrics.velocity_pct, metrics.jump_pct, metrics.jerk_rad_s3) == (share, share, 0.0)


def test_metrics_of_joints_without_targets(
    retargeters: dict[str, Retargeter], results: dict[tuple[str, int], Retargeted]
) -> None:
    result = results["h1", 16]
    root, q = result.motion.root_pose, result.motion.joint_positions
    assert root is not None
    assert q is not None
    metrics = evaluate_joints(retargeters["h1"], root, q, result.source, result.targets.contact)
    errors = ("hand_cm", "hand_p95_cm", "foot_cm", "foot_p95_cm")
    assert np.isnan([getattr(metrics, name) for name in errors]).all()
    known = evaluate(retargeters["h1"], result)
    assert dataclasses.replace(metrics, **{name: getattr(known, name) for name in errors}) == known
    with pytest.raises(ValueError, match=f"{len(root) - 1}, {len(q)}, "):
        evaluate_joints(retargeters["h1"], root[1:], q, result.source, result.targets.contact)


def test_mean_metrics(retargeters: dict[str, Retargeter], results: dict[tuple[str, int], Retargeted]) -> None:
    one = evaluate(retargeters["h1"], results["h1", 3])
    a = dataclasses.replace(one, hand_cm=1.0, balance_cm=float("nan"), frames=10)
    b = dataclasses.replace(one, hand_cm=4.0, balance_cm=2.0, frames=20)
    mean = Metrics.mean([a, b])
    assert mean.hand_cm == pytest.approx(3.0)
    assert mean.balance_cm == pytest.approx(2.0)
    assert mean.frames == 30
    with pytest.raises(ValueError, match="at least one clip"):
        Metrics.mean([])


def test_gates(retargeters: dict[str, Retargeter], results: dict[tuple[str, int], Retargeted]) -> None:
    metrics = evaluate(retargeters["h1"], results["h1", 0])
    high = np.full(40, 1.0)
    assert gate(metrics, high, 1.03, 20.0, GateConfig()) == ""
    assert gate(dataclasses.replace(metrics, skate_cm_s=20.0), high, 1.03, 20.0, GateConfig()) == "skate_cm_s 20.00 over 8"
    assert gate(dataclasses.replace(metrics, foot_cm=float("nan")), high, 1.03, 20.0, GateConfig()).startswith("foot_cm")
    assert gate(dataclasses.replace(metrics, self_pct=10.0), high, 1.03, 20.0, GateConfig()) == ""
    assert gate(dataclasses.replace(metrics, self_pct=12.0), high, 1.03, 20.0, GateConfig()) == "self_pct 12.00 over 10"
    limits = dataclasses.asdict(GateConfig())
    for name in set(limits) - {"low_pelvis", "low_pelvis_s"}:
        worse = dataclasses.replace(metrics, **{name: limits[name] + 0.5})
        assert gate(worse, high, 1.03, 20.0, GateConfig()).startswith(f"{name} ")
    low = high.copy()
    low[5:25] = 0.3
    assert gate(metrics, low, 1.03, 20.0, GateConfig()) == "pelvis below 0.5 of standing for 1.0 s"


def test_phc_list_counts() -> None:
    decisions = [entry.decision for entry in phc_list().values()]
    assert decisions.count("truncate") == 313
    # 14,616 clips; 11,642 whole and 313 cut ones remain.
    assert 14616 - len(decisions) == 11642


def test_phc_list_applies_to_mirrored_ids() -> None:
    joints = generate_clip(0, 6).joints
    clip = HumanMotion("000002", np.tile(joints, (4, 1, 1)), 20.0, (Caption("a"), Caption("b", 9.0, 9.5)))
    assert apply_phc_list(clip) is clip
    cut = apply_phc_list(dataclasses.replace(clip, name="M000006", hand_opening=np.zeros((len(clip.joints), 2))))
    assert isinstance(cut, HumanMotion)
    assert len(cut.joints) == 109
    assert cut.captions == (Caption("a"),)
    assert apply_phc_list(dataclasses.replace(clip, name="000013")) == "PHC list: airborne"
    assert apply_phc_list(dataclasses.replace(clip, name="000001")) == "PHC list: no_amass_key"


def test_automatic_rule() -> None:
    clip = generate_clip(0, 6)
    assert automatic_rule(clip) == ""
    lifted = HumanMotion("a", clip.joints + np.array([0.0, 0.0, 0.2]), 20.0)
    assert automatic_rule(lifted).startswith("starts 0.2")
    flying = clip.joints.copy()
    flying[1:] += [0, 0, 0.4]
    assert "both feet above" in automatic_rule(HumanMotion("a", flying, 20.0))


@pytest.mark.parametrize(
    ("height_m", "frames", "reason"), [(0.25, 31, "both feet above 0.2 m for 31 frames"), (0.25, 30, ""), (0.2, 60, "")]
)
def test_a_clip_is_in_the_air_after_thirty_frames_above_a_fifth_of_a_metre(height_m: float, frames: int, reason: str) -> None:
    joints = np.zeros((80, 22, 3))
    joints[10 : 10 + frames, [index("left_foot"), index("right_foot")], 2] = height_m
    joints[:60, index("left_foot"), 2] = np.maximum(joints[:60, index("left_foot"), 2], height_m)  # one foot is not both
    joints[0] = 0.0
    assert automatic_rule(HumanMotion("a", joints, 20.0)) == reason


def test_admission() -> None:
    clip = dataclasses.replace(generate_clip(0, 6), name="000013")
    assert admit(clip, use_list=False) is clip
    assert admit(clip, use_list=True) == "PHC list: airborne"
    lifted = dataclasses.replace(clip, joints=clip.joints + np.array([0.0, 0.0, 0.2]))
    assert str(admit(lifted, use_list=False)).startswith("starts 0.2")


def test_report_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert report(["table"]) == 2
    assert "'table' is not key=value" in capsys.readouterr().err
    assert report(["clips=0"]) == 2
    assert "clips=0: at least 1" in capsys.readouterr().err
    assert report(["clips=1"]) == 0
    out = capsys.readouterr().out
    assert "skate_cm_s" in out and "physics" not in out


def test_report_columns(retargeters: dict[str, Retargeter]) -> None:
    clip = generate_clip(0, 6)
    part = dataclasses.replace(clip, joints=clip.joints[:12], hand_opening=None)
    plain, simulated = (measure("x1", retargeters["x1"], [part], physics) for physics in (False, True))
    assert plain.physics is None and plain.metrics == simulated.metrics
    assert simulated.physics is not None and simulated.physics.joint_deg < 4.0
    labels = list(table([plain, simulated]).columns[0].cells)
    assert labels[-5:] == [f"physics: {name}" for name in PHYSICS]
    assert list(table([plain]).columns[0].cells)[-1] == "frames"


@pytest.mark.motions
@pytest.mark.parametrize("robot", ROBOTS)
def test_real_clips_meet_the_targets(retargeters: dict[str, Retargeter], robot: str) -> None:
    clips = [path for path in find_demo_clips() if path.suffix == ".pt"]
    if not clips:
        pytest.skip("real clips are not installed; run `make motions`")
    for path in clips:
        metrics = evaluate(retargeters[robot], retargeters[robot](load_omomo(path)))
        assert metrics.hand_cm < 1.0
        assert metrics.foot_cm < 1.0
        assert metrics.arm_deg < 8.0
        assert metrics.leg_deg < 15.0
        assert metrics.skate_cm_s < 5.0
        assert metrics.penetration_cm < 0.6
        assert metrics.limit_pct == 0.0


@pytest.mark.motions
def test_real_mocap_has_a_human_shape() -> None:
    clips = [path for path in find_demo_clips() if path.suffix == ".npy"]
    if not clips:
        pytest.skip("real clips are not installed; run `make motions`")
    for path in clips:
        clip = load_mocap(path)
        thigh = np.linalg.norm(clip.joints[:, 4] - clip.joints[:, 1], axis=1)
        forearm = np.linalg.norm(clip.joints[:, 20] - clip.joints[:, 18], axis=1)
        assert 0.3 < thigh.mean() < 0.5
        assert thigh.std() < 0.02
        assert 0.2 < forearm.mean() < 0.35


def test_loaders_refuse_other_shapes(tmp_path) -> None:
    import torch

    torch.save(torch.zeros(4, 10), tmp_path / "a.pt")
    with pytest.raises(ValueError, match=r"\(4, 10\)"):
        load_omomo(tmp_path / "a.pt")
    torch.save({"a": 1}, tmp_path / "b.pt")
    with pytest.raises(ValueError, match="dict"):
        load_omomo(tmp_path / "b.pt")
    np.save(tmp_path / "c.npy", np.zeros((3, 22, 3)))
    with pytest.raises(ValueError, match=r"\(3, 22, 3\)"):
        load_mocap(tmp_path / "c.npy")
