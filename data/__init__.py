"""Motion data and plain records: generation, HumanML3D, retargeting, filtering, alignment shards."""
