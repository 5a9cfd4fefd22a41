"""Planners: from an observation to the text of the next plan step. Nothing here imports the simulator, so none can peek."""
