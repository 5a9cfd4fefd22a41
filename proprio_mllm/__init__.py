"""Proprio-MLLM: a proprioception-aware multimodal planner, its training and its evaluation."""
