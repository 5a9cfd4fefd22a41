"""Processors of the checkpoints that answer chats in this process, without their video halves.

`AutoProcessor` builds a video processor too, which needs torchvision, and picks another image code where torchvision is there;
these classes need Pillow alone and give the same pixels everywhere. They read a checkpoint's own files, old layout or new.

Paper: the local baselines of Table II, Qwen2.5-VL and InternVL2.5.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from jinja2.exceptions import TemplateError
from transformers import PreTrainedTokenizerBase
from transformers.models.got_ocr2.image_processing_pil_got_ocr2 import GotOcr2ImageProcessorPil
from transformers.models.internvl.processing_internvl import InternVLProcessor
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
from transformers.processing_utils import ProcessorMixin

from proprio_mllm.model.processor import ProprioProcessor

__all__ = ["PROCESSORS", "InternVLImages", "QwenImages", "load_chat_processor"]


class QwenImages(ProprioProcessor):
    """Qwen2.5-VL's; the chat template has to be the checkpoint's own."""

    def __init__(
        self,
        image_processor: Qwen2VLImageProcessorPil | None = None,
        tokenizer: PreTrainedTokenizerBase | None = None,
        chat_template: str | None = None,
        **kwargs: object,
    ) -> None:
        super().__init__(image_processor, tokenizer, _template(chat_template, tokenizer), **kwargs)


class InternVLImages(InternVLProcessor):
    """InternVL's (`-hf` checkpoints): pictures become tiles of one size and, from two tiles on, a small view of the whole."""

    # The base class finds its parts in this signature, so the name `video_processor` must not stand in it.
    def __init__(
        self,
        image_processor: GotOcr2ImageProcessorPil | None = None,
        tokenizer: PreTrainedTokenizerBase | None = None,
        image_seq_length: int = 256,
        chat_template: str | None = None,
        **kwargs: object,
    ) -> None:
        names = ("start_image_token", "end_image_token", "context_image_token")
        missing = [name for name in names if getattr(tokenizer, name, None) is None]
        if missing:
            raise ValueError(f"its tokenizer does not name {', '.join(missing)}")
        tokens: Any = tokenizer
        self.image_seq_length = image_seq_length
        self.start_image_token, self.start_image_token_id = tokens.start_image_token, tokens.start_image_token_id
        self.end_image_token, self.end_image_token_id = tokens.end_image_token, tokens.end_image_token_id
        self.image_token, self.image_token_id = tokens.context_image_token, tokens.context_image_token_id
        ProcessorMixin.__init__(self, image_processor, tokenizer, chat_template=_template(chat_template, tokenizer))

    def __call__(self, images: Any = None, text: Any = None, videos: Any = None, **kwargs: Any) -> Any:
        """Ids and tiles, the tiles of all pictures in order. What the base class adds is the order of pictures and videos."""
        made = ProcessorMixin.__call__(self, images=images, text=text, **kwargs)
        made.pop("num_patches", None)
        return made


def _template(own: str | None, tokenizer: PreTrainedTokenizerBase | None) -> str:
    """The processor's chat template, or the tokenizer's, where older checkpoints keep it."""
    template = own or getattr(tokenizer, "chat_template", None)
    if not isinstance(template, str):
        raise ValueError("it has no chat template, which says how a conversation is written")
    return template


#: Model types that can answer, with their processors.
PROCESSORS: Final[Mapping[str, type[ProcessorMixin]]] = MappingProxyType({"qwen2_5_vl": QwenImages, "internvl": InternVLImages})


def load_chat_processor(folder: Path, model_type: str) -> Any:
    """The processor stored in a folder.

    Args:
        folder: with tokenizer, image processor and chat template.
        model_type: key of `PROCESSORS`.

    Raises:
        ValueError: when it has no chat template, or one that cannot write a question, or lacks tokens for pictures.
        OSError: when files are missing.
    """
    kind = PROCESSORS[model_type]
    processor: Any = kind.from_pretrained(str(folder), local_files_only=True, trust_remote_code=False, backend="pil")
    chat = [{"role": "user", "content": [{"type": "text", "text": "look"}]}]
    try:
        written = processor.apply_chat_template(chat, tokenize=False)
    except TemplateError as error:
        raise ValueError(f"its chat template cannot write a question: {error}") from error
    tokenizer = processor.tokenizer
    added = tokenizer("")["input_ids"]
    if added not in ([], [tokenizer.bos_token_id]):
        raise ValueError(f"its tokenizer adds {tokenizer.convert_ids_to_tokens(added)} to every text; allowed: a start token")
    if added and not written.startswith(tokenizer.bos_token):
        # InternVL2.5's tokenizer writes the start token, not its template. Control tokens in texts can be told from those of
        # the template only where the template writes them all.
        processor.chat_template = "{{ bos_token }}" + processor.chat_template
    return processor
