"""Writing policy cards, and their pages for people."""

from __future__ import annotations

from pathlib import Path

from airl_mav.core.files import replace_file, write_json
from airl_mav.policy.card import (
    CARD_FILE,
    SCHEMA,
    MeasuredResult,
    PolicyCard,
    read_card,
    read_model,
    read_torch_program,
)
from airl_mav.policy.model_card import MARK, MODEL_CARD_FILE, model_card


def write_card(folder: Path, card: PolicyCard) -> None:
    """Write the card beside the policy that it is for. The old card stays until the new is whole.

    Its page for people, `README.md`, is written after it, unless somebody else's has that name.

    Raises:
        UsageError: The folder holds another policy, or none.
    """
    read_model(folder, card)
    if card.torch_sha256 is not None:
        read_torch_program(folder, card)
    plain = {"schema": SCHEMA, **card.model_dump(mode="json")}
    write_json(folder / CARD_FILE, plain)
    write_model_card(folder, card)


def write_model_card(folder: Path, card: PolicyCard) -> None:
    """Write a card's page for people, unless the folder has one that was not made so."""
    page = folder / MODEL_CARD_FILE
    if not page.exists() or MARK.encode() in page.read_bytes():
        replace_file(page, model_card(card).encode())


def add_result(folder: Path, result: MeasuredResult) -> PolicyCard:
    """Write a result onto a card, in place of an earlier one of the same arena, level and latency.

    Raises:
        UsageError: See `read_card`.
    """
    card = read_card(folder)
    others = [each for each in card.results if _conditions(each) != _conditions(result)]
    results = tuple(sorted([*others, result], key=_conditions))
    card = card.model_copy(update={"results": results})
    write_card(folder, card)
    return card


def _conditions(result: MeasuredResult) -> tuple[str, str, str]:
    return result.level, result.arena, result.latency or ""
