"""Released weights to the Hugging Face hub: `python -m proprio_mllm push weights/tiny repo=NAME/proprio-mllm-tiny`.

Says what would be sent, and sends it with `send=true` (`HF_HUB_OFFLINE=0`, and a token from `hf auth login`). A folder of one
model becomes a repository as it is. Models that share a backbone have to stay side by side, so they are sent together, by the
folder that holds them, under a card of their own.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import httpx2
from huggingface_hub import CommitOperationAdd, HfApi, ModelCard
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalTokenNotFoundError, OfflineModeIsEnabled
from huggingface_hub.utils import validate_repo_id

from configs.arguments import command, read_named
from configs.origin import PROVENANCE
from data.files import DamagedFileError, read_json
from proprio_mllm.model.tensors import check_files


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        repo: `OWNER/NAME` on the hub.
        send: whether to send; otherwise what would be sent is listed.
        private: whether a new repository is private.
        message: of the commit.
    """

    repo: str
    send: bool = False
    private: bool = True
    message: str = "Weights of Proprio-MLLM"


def released(folder: Path) -> list[Path]:
    """The folders of stored models that make up a repository, checked.

    Raises:
        DamagedFileError: when a file is not what was written.
        ValueError: when there is no released model, or one whose backbone would stay behind.
    """
    found = [folder] if (folder / "config.json").is_file() else sorted(path.parent for path in folder.glob("*/config.json"))
    if not found or any(not (model / name).is_file() for model in found for name in (PROVENANCE, "README.md")):
        raise ValueError(f"{folder} holds no released weights: `python train.py release=FOLDER` writes them")
    for model in found:
        stored = read_json(model / "config.json")
        check_files(model, stored.get("files", {}))
        if "backbone" in stored and not (model / stored["backbone"]["folder"]).resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"{model} shares the backbone of {model / stored['backbone']['folder']}: push {model.parent}")
    return found


def operations(folder: Path) -> list[CommitOperationAdd]:
    """Every file of a repository, its card included.

    Raises:
        DamagedFileError: as `released`.
        ValueError: as `released`, or when a card's header is none that the hub reads.
    """
    models = released(folder)
    files = [path for model in models for path in sorted(model.rglob("*")) if path.is_file()]
    added = [CommitOperationAdd(path.relative_to(folder).as_posix(), path) for path in files]
    if models != [folder]:
        added.insert(0, CommitOperationAdd("README.md", _card(models).encode()))
    return added


def _card(models: Sequence[Path]) -> str:
    """A card for several models: the header of the first, and a line for each."""
    cards = [ModelCard.load(model / "README.md") for model in models]
    about = []
    for model, card in zip(models, cards, strict=True):
        title, said = [line for line in card.text.splitlines() if line][:2]
        about.append(f"| [`{model.name}`]({model.name}/README.md) | {title.removeprefix('# ')} | {said} |")
    rows = "\n".join(about)
    return f"---\n{cards[0].data}\n---\n\n# Proprio-MLLM\n\n| folder | model | |\n|---|---|---|\n{rows}\n"


@command(DamagedFileError, HFValidationError, ValueError)
def main(arguments: Sequence[str]) -> int:
    """Command line."""
    (name,), options = read_named(Options, arguments, ("FOLDER",))
    validate_repo_id(options.repo)
    added = operations(Path(name))
    total = 0
    for one in added:
        total += one.upload_info.size
        sys.stdout.write(f"{one.upload_info.size:>12,}  {one.path_in_repo}\n")
    sys.stdout.write(f"{total:>12,}  bytes in {len(added)} files, to {options.repo}\n")
    if not options.send:
        sys.stdout.write("nothing was sent; send=true does\n")
        return 0
    api = HfApi()
    try:
        api.create_repo(options.repo, private=options.private, exist_ok=True)
        done = api.create_commit(options.repo, added, commit_message=options.message)
    except OfflineModeIsEnabled:
        raise ValueError("the hub is switched off here: HF_HUB_OFFLINE=0 python -m proprio_mllm push …") from None
    except (HfHubHTTPError, LocalTokenNotFoundError, OSError, httpx2.HTTPError) as error:
        sys.stderr.write(f"push: nothing was changed on the hub: {error}\n")
        return 1
    sys.stdout.write(f"{done.commit_url}\n")
    return 0
