"""Ways into the simulator: Gymnasium, AI2-THOR's and DualTHOR's Controller, remote worlds."""
