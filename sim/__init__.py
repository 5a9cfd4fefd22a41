"""DualTHOR re-founded on MuJoCo: robots, rooms, skills, tasks, and the privileged expert."""
