"""Learned policy: encode, infer, decide, in rehearsal and training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import CommandKind
from airl_mav.core.errors import UsageError
from airl_mav.policy.actions import ActionSpec, AnyAction, command, discrete_actions
from airl_mav.policy.card import (
    TORCH_FILE,
    Memory,
    PolicyCard,
    Runtime,
    RuntimeName,
    TorchRuntime,
    blank_memory,
    check_trust,
    open_model,
    outputs_of,
    read_card,
    read_torch_program,
)
from airl_mav.policy.layouts import ablated, boxes, encode_layout
from airl_mav.policy.observation import Observation
from airl_mav.policy.observation_spec import camera_mismatch, further_mismatch
from airl_mav.profiles.loading import profiles_dir


class LearnedPolicy:
    """A network with its card. Implements `actions.Policy`.

    A network with memory stores the state of one flight, or of n parallel flights. An object is
    used from the first to the last decision. `with_generator` returns an object for the next
    flight.
    """

    def __init__(
        self,
        card: PolicyCard,
        runtime: Runtime,
        *,
        rng: np.random.Generator | None = None,
        ablate: str | None = None,
    ) -> None:
        """Initialize the policy; a card with an epsilon requires an `rng`.

        `ablate` names an input to set to zero, as in the paper's sensor ablation. Raises UsageError
        if the layout has no such input.
        """
        if ablate is not None and ablate not in boxes(card.observation):
            known = ", ".join(boxes(card.observation))
            raise UsageError(f"ablate = {ablate!r}: accepted: {known}")
        self.card = card
        self._runtime = runtime
        self._rng = rng
        self._ablate = ablate
        self._fitting: tuple[Intrinsics, ...] = ()
        """Intrinsics of the cameras that passed the check."""
        self._memory: Memory | None = None
        """Memory of the network; None before the first decision."""

    @property
    def name(self) -> str:
        """Name on the card."""
        return self.card.name

    @property
    def commands(self) -> CommandKind:
        """Command kind of the actions."""
        return self.card.actions.commands

    def with_generator(self, rng: np.random.Generator) -> LearnedPolicy:
        """Return the same policy at its first decision, with another random generator."""
        return LearnedPolicy(self.card, self._runtime, rng=rng, ablate=self._ablate)

    def refuses(self, camera: Intrinsics) -> str | None:
        """Return why a camera cannot serve the policy, or None when it can."""
        return camera_mismatch(self.card.observation, camera)

    def refuses_further(self, cameras: Mapping[str, Intrinsics]) -> str | None:
        """Return why additional cameras, by name, cannot serve the policy, or None."""
        return further_mismatch(self.card.observation, cameras)

    def act(self, observation: Observation) -> AnyAction:
        """Return the action for an observation of one vehicle.

        Raises:
            UsageError: The camera differs from the camera in training.
            ValueError: The network outputs NaN.
        """
        further = observation.further
        looks = (observation.intrinsics, *(each.intrinsics for each in further.values()))
        if looks != self._fitting:
            lenses = {name: each.intrinsics for name, each in further.items()}
            reason = self.refuses(observation.intrinsics) or self.refuses_further(lenses)
            if reason is not None:
                raise UsageError(f"policy {self.card.name}: {reason}")
            self._fitting = looks
        encoded = encode_layout(self.card.observation, observation.rows(None))
        return command(self.card.actions, self.act_batch(encoded)[0])

    def act_batch(
        self, encoded: Mapping[str, NDArray[Any]], rng: np.random.Generator | None = None
    ) -> NDArray[Any]:
        """Return the actions of n vehicles, as `action_sets.commands` takes them; see `decide`.

        `encoded` are the arrays of the card's layout, each with n rows. The default `rng` is the
        policy's own generator. Raises ValueError as `outputs`, and if an output is NaN.
        """
        return decide(self.card.actions, self.outputs(encoded), self.card.epsilon, rng or self._rng)

    def outputs(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return a score (n, k) for each discrete action, or the action, of n flights.

        A network with memory updates its memory. Raises ValueError if the number of flights
        changed.
        """
        if self._ablate is not None:
            encoded = ablated(encoded, self._ablate)
        return self._remembering(encoded) if self.card.state else self._runtime.infer(encoded)

    def _remembering(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the outputs of a network with memory, and update the memory."""
        n = len(next(iter(encoded.values())))
        memory = blank_memory(self.card.state, n) if self._memory is None else self._memory
        known = len(next(iter(memory.values())))
        if known != n:
            raise ValueError(f"{n} flights; accepted: {known}, as at the first decision")
        outputs, self._memory = self._runtime.step(encoded, memory)
        return outputs


def decide(
    actions: ActionSpec,
    outputs: NDArray[np.float32],
    epsilon: float = 0.0,
    rng: np.random.Generator | None = None,
) -> NDArray[Any]:
    """Return the actions of a network's outputs (n, k): the best score, or a random action.

    `epsilon` is the share of random actions of a discrete set. Returns (n,) int64 for a discrete
    set, (n, k) float32 for a continuous one. Raises ValueError if an output is NaN, or random
    actions have no `rng`.
    """
    if np.isnan(outputs).any():
        raise ValueError("the network's output is not a number")
    count = discrete_actions(actions)
    if count is None:
        return outputs
    chosen: NDArray[np.int64] = outputs.argmax(axis=1)
    if epsilon > 0.0:
        if rng is None:
            raise ValueError(f"epsilon = {epsilon:g} needs a random generator")
        random = rng.integers(0, count, len(chosen))
        chosen = np.where(rng.random(len(chosen)) < epsilon, random, chosen)
    return chosen


def load_learned(
    folder: Path,
    card: PolicyCard | None = None,
    *,
    runtime: RuntimeName = "onnx",
    threads: int = 1,
    rng: np.random.Generator | None = None,
    ablate: str | None = None,
    trust: bool = False,
) -> LearnedPolicy:
    """Load a policy from a folder with `policy.onnx` and `card.json`.

    The default card is read from the folder. `runtime`, `threads` and `trust` are as in
    `open_network`, `rng` and `ablate` as in `LearnedPolicy`. An inference is run at once, so that
    the first decision in flight is as fast as the others. Raises UsageError if card and policy do
    not match, or the runtime is not installed or not trusted.
    """
    card = card or read_card(folder)
    check_trust(folder, card, trust=trust)
    network = open_network(folder, card, runtime, threads, trust=trust)
    policy = LearnedPolicy(card, network, rng=rng, ablate=ablate)
    blank = {k: np.zeros((1, *box.shape), box.dtype) for k, box in boxes(card.observation).items()}
    if card.state:
        outputs, _ = network.step(blank, blank_memory(card.state, 1))
    else:
        outputs = network.infer(blank)
    found, wanted = outputs.shape, (1, outputs_of(card.actions))
    if found != wanted:
        raise UsageError(f"policy {card.name}: output {found}; accepted: {wanted}")
    return policy


def open_network(
    folder: Path, card: PolicyCard, runtime: RuntimeName, threads: int, *, trust: bool = False
) -> Runtime:
    """Return the network of a card, ready for its first inference; `torch` takes `policy.pt2`.

    `trust` permits the folder's author to run code on this machine: `torch.export.load` falls back
    to unpickling, which runs code from the file. An ONNX model is data, and the policies of this
    package are trusted. A card may name code, too. Raises UsageError as `load_learned`.
    """
    if runtime == "onnx":
        return open_model(folder, card, threads, trust=trust)
    program = read_torch_program(folder, card)
    shipped = folder.resolve().is_relative_to((profiles_dir() / "policies").resolve())
    if not (trust or shipped):
        raise UsageError(
            f"{folder}: its {TORCH_FILE} can run any code on this machine; accepted: with --trust, "
            "if you trust its maker, or with the onnx runtime"
        )
    try:
        return TorchRuntime(program, card.observation, threads, card.state)
    except ValueError as error:
        raise UsageError(f"{folder / TORCH_FILE}: {error}") from None
