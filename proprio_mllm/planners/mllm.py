"""Plans with a stored model: Proprio-MLLM, its ablations, and the base model, all through the same classes.

What sets them apart is stored with the weights (`config.json`): MPE mode, CSE switch, and whether prompts carry motion tokens.
The reply is greedy unless a temperature is given; then tokens are drawn from the episode's generator.

Paper: Proprio-MLLM as embodied planner, with reflection or without (Table III). The paper's prompt is not published. Here
reflection is what the model was trained for: failed steps stand in the log with their codes, and the next step answers them.
Without it they are left out of the log, so that the model sees what its steps have changed and nothing of those that failed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from data.interface.feedback import Feedback
from data.interface.observation import Observation
from proprio_mllm.model.batch import Collator
from proprio_mllm.model.building import load_model, load_motion
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.observing import plan_example
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo, check_weights, parse_reply, without_failures

__all__ = ["MllmPlanner"]


class MllmPlanner:
    """A model in this process.

    Args:
        model: in evaluation mode.
        motion: the motion tokenizer; needed when the model's prompts carry motion tokens.
        temperature: 0 takes the most likely token.
        max_new_tokens: longest reply.
        reflection: whether failed steps are in the log.

    Raises:
        ValueError: when motion tokens are wanted and there is no tokenizer for them.
    """

    privileged = False

    def __init__(
        self,
        model: ProprioMLLM,
        motion: MotionTokenizer | None,
        temperature: float = 0.0,
        max_new_tokens: int = 48,
        reflection: bool = True,
    ) -> None:
        if model.cfg.proprioception and motion is None:
            raise ValueError(f"model {model.cfg.name!r} reads motion tokens: it has no motion tokenizer")
        self.model = model
        self.motion = motion
        self.temperature = temperature
        self.max_new_tokens = max_new_tokens
        self.reflection = reflection
        self.image_size = model.cfg.image_size
        self._collator = Collator(model.processor, model.cfg)
        self._generator = torch.Generator().manual_seed(0)

    @staticmethod
    def load(
        folder: str | Path,
        adapter: str | None = None,
        temperature: float = 0.0,
        max_new_tokens: int = 48,
        train: str = "",
        reflection: bool = True,
    ) -> MllmPlanner:
        """Reads a stored model.

        Args:
            folder: what `save_model` wrote.
            adapter: adapter to activate; None takes the first.
            temperature: see the class.
            max_new_tokens: see the class.
            train: command that makes the weights, for the message when they are absent.
            reflection: see the class.

        Raises:
            WeightsError: when the folder has no model.
        """
        path = check_weights(folder, train)
        model = load_model(path, adapter)
        if torch.cuda.is_available():
            model = model.to("cuda")
        return MllmPlanner(model, load_motion(path), temperature, max_new_tokens, reflection)

    def begin(self, task: TaskInfo, rng: np.random.Generator) -> torch.Generator:
        """The generator that draws the tokens of a new episode."""
        return torch.Generator().manual_seed(int(rng.integers(2**31)))

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Seeds the token draws of the new episode."""
        self._generator = self.begin(task, rng)

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The model's next step; earlier feedback is in the observation's history."""
        return self.step_batch([observation], [self._generator])[0]

    def step_batch(
        self, observations: Sequence[Observation], states: Sequence[torch.Generator] | None = None
    ) -> list[PlannerReply]:
        """One reply per observation; the latency is the batch's, shared equally."""
        started = time.perf_counter()
        shown = observations if self.reflection else [without_failures(one) for one in observations]
        prompts = [plan_example(one, self.model.cfg, self.motion) for one in shown]
        batch = self._collator(prompts, generation=True).to(self.model.device)
        rows = self.model.generate(batch, self.max_new_tokens, self.temperature, states)
        texts = self.model.processor.tokenizer.batch_decode(rows, skip_special_tokens=True)
        read = batch.attention_mask.sum(dim=1).tolist()
        each_s = (time.perf_counter() - started) / len(rows)
        return [parse_reply(text, int(count) + len(row), each_s) for text, row, count in zip(texts, rows, read, strict=True)]
