"""Robot descriptions and kinematics: one MJCF per robot, read by MuJoCo and by Pinocchio alike (paper: robots and control).

`specs/<name>.yaml` names the parts of a robot's MJCF, `spec.py` reads it, `kinematics.py` gives forward kinematics, `leg_ik.py`
and the arm solvers give inverse kinematics, `build_solver.robot_kit` puts them together. `build.py` makes the MJCF of H1 and X1
from their published kinematics.
"""

from robots.gl import select_backend as _select_backend

_select_backend()
