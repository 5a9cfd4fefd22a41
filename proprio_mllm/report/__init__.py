"""Reports: intervals, tables and figures of runs, ours and the paper's always apart."""
