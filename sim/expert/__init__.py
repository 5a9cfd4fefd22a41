"""The privileged expert: a job planner over object states and a lookahead in the simulator."""
