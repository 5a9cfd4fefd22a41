import dataclasses

import numpy as np
import pytest

from data.interface.observation import HistoryItem, Observation, Proprioception
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.observing import plan_example
from proprio_mllm.model.vocabulary import motion_text


@pytest.fixture
def observation(examples) -> Observation:
    view = examples[0].views[0]
    motion = np.random.default_rng(0).normal(size=(16, 6)).astype(np.float32)
    body = Proprioception(motion, 20.0, np.zeros(3), view.key_bodies)
    history = (HistoryItem("GoTo(Mug_1)", "GoTo(Mug_1) ok"),)
    return Observation("tidy up", "h1", view.image, view.camera, ("Mug_1",), ("Mug_1", "Pan_1"), body, history, 1, 9)


def test_observation_becomes_prompt_and_view(cfg, build, observation):
    tokenizer = MotionTokenizer(cfg.motion).eval()
    tokenizer.quantizer.inner._codebook.embed.normal_()
    example = plan_example(observation, cfg, tokenizer)
    codes = tokenizer.encode_window(observation.proprioception.motion)
    assert example.messages[-1].text == f"{motion_text(codes)}h1 2/9 tidy up\nsee Mug_1\nknow Pan_1\ndid\nGoTo(Mug_1) ok"
    model, collate = build(cfg)
    batch = collate([example], generation=True)
    assert batch.images.centroids[0] is not None
    assert len(model.generate(batch, 2)) == 1
    taught = plan_example(observation, cfg, tokenizer, "Done()")
    assert taught.messages[:-1] == example.messages
    assert taught.messages[-1].text == "Done()"


def test_proprioception_is_a_switch(cfg, observation):
    off = dataclasses.replace(cfg, proprioception=False)
    assert "motion" not in plan_example(observation, off, None).messages[-1].text
    with pytest.raises(ValueError, match="needs a motion tokenizer"):
        plan_example(observation, cfg, None)
