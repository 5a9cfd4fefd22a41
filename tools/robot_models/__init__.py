"""Makes the robots' MJCF under `robots/assets/` from their published kinematics: `python -m tools.robot_models`."""
