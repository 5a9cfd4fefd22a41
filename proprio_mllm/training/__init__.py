"""Training: one loop, and the stages of the paper as small objectives over shards. Never imports the simulator.

`base` and `dagger` stand in for the backbone's pretraining at the tiny size; `pointmap`, `tokenizer` (stage 1),
`alignment` (stage 2) and `selu` (stage 3) are the paper's parts. `pipeline` says what each stage needs and when its output is
current.
"""
