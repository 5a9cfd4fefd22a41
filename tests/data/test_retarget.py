import dataclasses

import numpy as np
import pytest

from configs.schema.data import GateConfig
from data.filter import admit, apply_phc_list, automatic_rule, gate, phc_list
from data.generator import generate_clip
from data.metrics import (
    Metrics,
    angle_deg,
    evaluate,
    evaluate_joints,
    limit_violation_pct,
    saturation_pct,
    skate_cm_s,
)
from data.motion import N_FEATURES, decode_key_bodies, heading_to_world
from data.omomo import find_demo_clips, load_mocap, load_omomo
from data.retarget import MAX_JOINT_VELOCITY, Retargeted, Retargeter
from data.retarget_report import PHYSICS, measure, table
from data.retarget_report import main as report
from data.skeleton import Caption, HumanMotion
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
