"""Motion in prompts: beside the text where it is shown, in it where it is learnt."""

from proprio_mllm.model.batch import Example
from proprio_mllm.model.chat import Encoded
from proprio_mllm.model.prompts import filled_motion, made_motion
from proprio_mllm.model.vocabulary import MOTION_END, MOTION_START, motion_text


def test_motion_that_is_shown_stands_beside_the_text(cfg, build):
    model, collate = build(cfg)

    def ids(text):
        return model.processor.tokenizer(text, add_special_tokens=False)["input_ids"]

    def where(before, motion, after):
        tokens = [*ids(before), *ids(motion), *ids(after)]
        example = Example(tokens=Encoded(tuple(tokens), (False,) * len(tokens)), start=7)
        return collate([example]).position_ids[:, 0].tolist()

    shown, text = motion_text([3, 1, 4, 1, 5]), "put the mug"
    plain, beside = where(text, "", "Pick(left"), where(text, shown, "Pick(left")
    head, length = len(ids(text)), len(ids(shown))
    for axis in range(3):
        assert beside[axis][:head] + beside[axis][head + length :] == plain[axis]
        assert beside[axis][head : head + length] == list(range(7 + head - length, 7 + head))


def test_motion_that_is_learnt_stands_in_the_text(cfg, build):
    model, collate = build(cfg)
    begin, end = model.processor.tokenizer.convert_tokens_to_ids([MOTION_START, MOTION_END])

    def steps(messages):
        batch = collate([Example(messages)])
        found = (batch.position_ids[0, 0].diff() != 1).nonzero()[:, 0] + 1
        return batch.input_ids[0].tolist(), found.tolist()

    assert steps(made_motion("a wave", [1, 2], cfg.prompt))[1] == []
    tokens, jumps = steps(filled_motion([1, None], [1, 2], cfg.prompt))
    first = tokens.index(begin)
    assert jumps == [first] and tokens.count(begin) == tokens.count(end) == 2, "the motion that is asked about, not the answer"
