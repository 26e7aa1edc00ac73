"""Writing policy cards, their pages for readers, and copies of policies with a changed card."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.files import replace_file, write_json
from airl_mav.policy.card import (
    CARD_FILE,
    ONNX_FILE,
    SCHEMA,
    TORCH_FILE,
    MeasuredResult,
    PolicyCard,
    load_card,
    read_card,
    read_model,
    read_torch_program,
)
from airl_mav.policy.model_card import MARK, MODEL_CARD_FILE, model_card


def write_card(folder: Path, card: PolicyCard) -> None:
    """Write the card into its policy's folder, atomically.

    The generated page `README.md` is written after the card, unless the folder has another page of
    this name. Raises UsageError if the folder contains another policy, or none.
    """
    read_model(folder, card)
    if card.torch_sha256 is not None:
        read_torch_program(folder, card)
    plain = {"schema": SCHEMA, **card.model_dump(mode="json")}
    write_json(folder / CARD_FILE, plain)
    write_model_card(folder, card)


def write_model_card(folder: Path, card: PolicyCard) -> None:
    """Write the page of a card, unless the folder has a page that was not generated."""
    page = folder / MODEL_CARD_FILE
    if not page.exists() or MARK.encode() in page.read_bytes():
        replace_file(page, model_card(card).encode())


def add_result(folder: Path, result: MeasuredResult) -> PolicyCard:
    """Write a result to a card; replaces a result with the same arena, level and latency."""
    card = read_card(folder)
    others = [each for each in card.results if _conditions(each) != _conditions(result)]
    results = tuple(sorted([*others, result], key=_conditions))
    card = card.model_copy(update={"results": results})
    write_card(folder, card)
    return card


def _conditions(result: MeasuredResult) -> tuple[str, str, str]:
    return result.level, result.arena, result.latency or ""


def copy_policy(
    source: Path, out: Path, changes: dict[str, Any], *, trust: bool = False
) -> PolicyCard:
    """Copy a policy to another folder with changes to its card, and return the card.

    The source's results do not apply: the new card has none until it is evaluated. `trust` permits
    the source's author to run code on this machine. Raises UsageError if the policy cannot be used,
    a change is out of range, or `out` is the source or cannot be written.
    """
    card = load_card(source, trust=trust)
    if out.resolve() == source.resolve():
        raise UsageError(f"{out}: accepted: another folder than the policy's own")
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: not a folder")
    plain = card.model_dump(mode="json") | {"results": ()} | changes
    copied = validated(PolicyCard, plain)
    try:
        out.mkdir(parents=True, exist_ok=True)
        replace_file(out / ONNX_FILE, read_model(source, card))
        if card.torch_sha256 is not None:
            replace_file(out / TORCH_FILE, read_torch_program(source, card))
        write_card(out, copied)
        if card.torch_sha256 is None:
            (out / TORCH_FILE).unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"{out}: {error.strerror}") from None
    return copied
