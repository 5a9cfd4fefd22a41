"""A model behind an OpenAI-compatible URL: OpenAI, Gemini's compatible endpoint, vLLM, `make serve`.

One client for all of them, the `openai` package, with its own retries (time-outs, broken connections, 408, 409, 429, 5xx) and
nothing stacked on them. Pictures are sent as data URLs of exactly the bytes they have, so that a digest of those bytes says
what a model saw.

Paper: baselines of Table II (GPT-4o and Gemini through their vendors' APIs).
"""

from __future__ import annotations

import base64
import dataclasses
import logging
import time
from typing import Any, Final

import openai

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.connection import MAX_REPLY_BYTES, bounded_client, checked_url, read_secret
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.openai_answers import failure_of, is_refusal, read_completion, shown_name
from proprio_mllm.backends.protocol import (
    BackendError,
    BackendSetupError,
    ChatImage,
    ChatMessage,
    ChatReply,
    ChatRequest,
    LostReplyError,
    UnreachableError,
)
from proprio_mllm.backends.structured import strict_schema

#: Given explicitly, because the client would otherwise take another one from the environment.
_OPENAI_URL: Final = "https://api.openai.com/v1"
_SHOWN_CHARACTERS: Final = 400
_LIST_TIMEOUT_S: Final = 5.0

logger = logging.getLogger(__name__)


class OpenAIChat:
    """Asks a server; any number of threads may do so at once.

    Args:
        cfg: of kind `openai`. The key is read from its environment variable now, and goes nowhere but to the server.
        limit_bytes: longest reply that is read.

    Raises:
        BackendSetupError: when there is no key, no usable URL, or the environment's proxy or certificates cannot be used.
    """

    def __init__(self, cfg: BackendConfig, limit_bytes: int = MAX_REPLY_BYTES) -> None:
        url = checked_url(cfg.base_url or _OPENAI_URL, cfg.name)
        self.identity = identity_of(cfg)
        self._cfg = cfg
        self._limit_bytes = limit_bytes
        self._secret = read_secret(cfg.key_env, cfg.name, optional=cfg.on_this_machine)
        if url.startswith("http:") and not cfg.on_this_machine:
            logger.warning("backend %s: the key in %s is sent unencrypted", cfg.name, cfg.key_env)
        try:
            http_client = bounded_client(cfg.timeout_s, cfg.on_this_machine, limit_bytes)
        except (ImportError, OSError, ValueError) as error:
            raise BackendSetupError(
                f"backend {cfg.name}: HTTP cannot be used as the environment asks (proxies: *_PROXY; certificates: SSL_CERT_*):"
                f" {type(error).__name__}: {error}"
            ) from error
        self._secret.guard()
        self._client = openai.OpenAI(
            api_key=self._secret.reveal(),
            base_url=url,
            timeout=http_client.timeout,
            max_retries=cfg.retries,
            http_client=http_client,
        )

    def complete(self, request: ChatRequest) -> ChatReply:
        """The model's reply.

        Raises:
            LostReplyError: when the reply did not come whole or is no chat completion.
            BackendSetupError: when every call would fail: a wrong key, an unknown model or path, no money left.
            BackendError: when the server does not answer after all attempts, or cannot answer this request.
        """
        if self._client.is_closed():
            raise BackendError(f"backend {self._cfg.name}: closed")
        start = time.perf_counter()
        reply = self._asked(request)
        latency_s = time.perf_counter() - start
        if isinstance(reply, BackendError):
            raise self._shown(reply)  # out here, so that no error of the client hangs on it
        if reply.prompt_tokens == 0 and reply.finish_reason != "refusal":
            logger.warning("backend %s: a reply without usable token counts", self._cfg.name)
        text, model = self._secret.redact(reply.text), self._secret.redact(reply.model)
        self._same_weights(model)
        return dataclasses.replace(reply, text=text, model=model, latency_s=latency_s)

    def revision(self) -> str | None:
        """Revision of the model as the server's list of models tells it; "" when it tells none, None when it is not there.

        OpenAI's format has no such field. The server of this project tells it, so that its replies are known by the weights.
        """
        try:
            listed = self._client.with_options(timeout=_LIST_TIMEOUT_S, max_retries=0).models.list()
            told = next(((card.model_extra or {}).get("revision") for card in listed.data if card.id == self._cfg.model), None)
        except openai.APIConnectionError as error:
            return None if isinstance(failure_of(error, _LIST_TIMEOUT_S, 0), UnreachableError) else ""
        except (openai.OpenAIError, AttributeError, TypeError, ValueError, RecursionError) as error:  # or it is no list
            logger.debug("backend %s: no list of models: %s", self._cfg.name, self._secret.redact(str(error)))
            return ""
        return shown_name(self._secret.redact(told)) if isinstance(told, str) else ""

    def close(self) -> None:
        """Closes its connections."""
        self._client.close()
        self._secret.release()

    def _asked(self, request: ChatRequest) -> ChatReply | BackendError:
        try:
            raw = self._client.chat.completions.with_raw_response.create(**_body(self._cfg, request))
            return read_completion(raw.http_response.content, raw.http_response.headers.get("content-type"))
        except LostReplyError as error:
            return error
        except openai.OpenAIError as error:
            if is_refusal(error):
                return ChatReply("", finish_reason="refusal", model=self._cfg.model)
            return failure_of(error, self._cfg.timeout_s, self._cfg.retries)

    def _shown(self, error: BackendError) -> BackendError:
        """An error for people: short, named after the backend, and without the key."""
        said = self._secret.redact(str(error))
        said = said if len(said) <= _SHOWN_CHARACTERS else f"{said[:_SHOWN_CHARACTERS]}…"
        if isinstance(error, UnreachableError):
            said = f"{self._client.base_url}: {said}"
            if self._cfg.on_this_machine:
                said += "; is a server running there? `make serve` starts this project's"
        return type(error)(f"backend {self._cfg.name}: {said}")

    def _same_weights(self, answered: str) -> None:
        """Refuses a reply of other weights than the run is known by, as after a restart of the server in its midst."""
        model, _, revision = answered.rpartition("@")
        if self._cfg.on_this_machine and self._cfg.revision and model == self._cfg.model and revision != self._cfg.revision:
            raise BackendSetupError(
                f"backend {self._cfg.name}: {self._client.base_url} answers as {answered}, and this run is of revision"
                f" {self._cfg.revision}; serve those weights, or start the command again"
            )

    def __repr__(self) -> str:
        """Name and identity."""
        return f"OpenAIChat({self._cfg.name}, {self.identity})"

    def __reduce__(self) -> tuple[type[OpenAIChat], tuple[BackendConfig, int]]:
        """Its configuration: whoever it is sent to reads the key from an environment of its own."""
        return OpenAIChat, (self._cfg, self._limit_bytes)


def _body(cfg: BackendConfig, request: ChatRequest) -> dict[str, Any]:
    body: dict[str, Any] = {
        "model": cfg.model,
        "messages": [_message(message) for message in request.messages],
        "temperature": request.temperature,
        cfg.token_limit_field: request.max_tokens,
    }
    if request.schema is not None and cfg.structured == "json_object":
        body["response_format"] = {"type": "json_object"}
    if request.schema is not None and cfg.structured == "json_schema":
        schema = {"name": request.schema.__name__, "strict": True, "schema": strict_schema(request.schema)}
        body["response_format"] = {"type": "json_schema", "json_schema": schema}
    return body


def _message(message: ChatMessage) -> dict[str, Any]:
    if not any(isinstance(part, ChatImage) for part in message.content):
        return {"role": message.role, "content": message.text}  # simple servers know texts alone
    return {"role": message.role, "content": [_part(part) for part in message.content]}


def _part(part: str | ChatImage) -> dict[str, Any]:
    if isinstance(part, str):
        return {"type": "text", "text": part}
    data = base64.b64encode(part.data).decode("ascii")
    return {"type": "image_url", "image_url": {"url": f"data:{part.media_type};base64,{data}"}}
