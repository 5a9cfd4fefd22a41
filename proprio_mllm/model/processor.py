"""Qwen2.5-VL's processor without its video half, and the chat template.

`Qwen2_5_VLProcessor` needs torchvision for videos, which this project does not use. The subclass below loads both from folders
written here and from released checkpoints, in the new and the legacy layout. Load with `ProprioProcessor.from_pretrained`, not
with `AutoProcessor`, which does not know the class.
"""

from __future__ import annotations

from pathlib import Path

from transformers import BatchFeature, PreTrainedTokenizerBase
from transformers.models.qwen2_5_vl.processing_qwen2_5_vl import Qwen2_5_VLProcessor
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
from transformers.processing_utils import ProcessorMixin

DEFAULT_SYSTEM = "You are a helpful assistant."
#: ChatML as Qwen2.5-VL writes it: a default system line, images as one pad between the vision delimiters.
CHAT_TEMPLATE = (
    "{% for message in messages %}"
    "{% if loop.first and message['role'] != 'system' %}<|im_start|>system\n" + DEFAULT_SYSTEM + "<|im_end|>\n{% endif %}"
    "<|im_start|>{{ message['role'] }}\n"
    "{% if message['content'] is string %}{{ message['content'] }}{% else %}"
    "{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}<|vision_start|><|image_pad|><|vision_end|>"
    "{% elif part['type'] == 'text' %}{{ part['text'] }}{% endif %}"
    "{% endfor %}{% endif %}<|im_end|>\n"
    "{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)


class ProprioProcessor(Qwen2_5_VLProcessor):
    """Images and text to model inputs; no videos."""

    # The base class finds its parts in this signature, so the name `video_processor` must not stand in it.
    def __init__(
        self,
        image_processor: Qwen2VLImageProcessorPil | None = None,
        tokenizer: PreTrainedTokenizerBase | None = None,
        chat_template: str | None = None,
        **kwargs: object,
    ) -> None:
        if tokenizer is None or image_processor is None:
            raise ValueError("ProprioProcessor needs a tokenizer and an image processor")
        self.image_token = "<|image_pad|>"
        self.video_token = "<|video_pad|>"
        self.image_token_id = tokenizer.convert_tokens_to_ids(self.image_token)
        self.video_token_id = tokenizer.convert_tokens_to_ids(self.video_token)
        # Legacy checkpoints keep the template with the tokenizer.
        template = chat_template or tokenizer.chat_template or CHAT_TEMPLATE
        ProcessorMixin.__init__(self, image_processor, tokenizer, chat_template=template)

    @property
    def model_input_names(self) -> list[str]:
        """Names of what the call returns."""
        return [*self.tokenizer.model_input_names, *self.image_processor.model_input_names]

    def images(self, images: list) -> BatchFeature:
        """Pixel values and grids of (H, W, 3) uint8 images: `pixel_values` (patches, 1176), `image_grid_thw` (images, 3)."""
        return self.image_processor(images=images, return_tensors="pt")


def make_processor(tokenizer: PreTrainedTokenizerBase, image_size: int) -> ProprioProcessor:
    """A processor for square images of `image_size` pixels around a tokenizer trained here."""
    area = image_size * image_size
    image_processor = Qwen2VLImageProcessorPil(size={"shortest_edge": 3136, "longest_edge": max(area, 3136)})
    return ProprioProcessor(image_processor, tokenizer, chat_template=CHAT_TEMPLATE)


def load_processor(path: str | Path, image_size: int) -> ProprioProcessor:
    """The processor of a checkpoint, with its images limited to `image_size` pixels squared."""
    processor = ProprioProcessor.from_pretrained(str(path))
    processor.image_processor.size = {"shortest_edge": 3136, "longest_edge": max(image_size * image_size, 3136)}
    return processor
