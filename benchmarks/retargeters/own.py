"""This project's retargeter on the clips of a job: `python own.py JOB.npz RESULT.npz`.

The time includes the targets, the resampling test and the motion features that `Retargeter` makes beside the joints.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path

from exchange import Job, Outcome, Results, timed

from data.retarget import Retargeter
from data.skeleton import HumanMotion
from robots.spec import load_robot


def main(job_path: Path, result_path: Path) -> None:
    job = Job.read(job_path)
    retargeter = Retargeter(load_robot(job.robot["name"]))
    outcomes = []
    for clip in job.clips:
        human = HumanMotion(clip.name, clip.joints, job.fps)
        result, seconds = timed(lambda human=human: retargeter(human), job.repeats)
        assert result.motion.root_pose is not None
        assert result.motion.joint_positions is not None
        outcomes.append(Outcome(result.motion.root_pose, result.motion.joint_positions, seconds))
    versions = {name: version(name) for name in ("pin", "numpy")}
    Results(list(retargeter.robot.joint_names), versions, outcomes).write(result_path)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
