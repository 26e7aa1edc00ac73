"""Copy a policy: the same network under another card, so that it is flown otherwise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.files import replace_file
from airl_mav.policy.card import (
    ONNX_FILE,
    TORCH_FILE,
    PolicyCard,
    load_card,
    read_model,
    read_torch_program,
)
from airl_mav.policy.card_writing import write_card


def copy_policy(
    source: Path, out: Path, changes: dict[str, Any], *, trust: bool = False
) -> PolicyCard:
    """Write a policy's network to another folder, its card with changes, and return the card.

    Measurements of the source do not apply: the card has no results until it is evaluated. `trust`
    permits the source's maker to run code on this machine.

    Raises:
        UsageError: The policy cannot be used, a change is out of range, or `out` is the source or
            cannot be written.
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
