"""Registry of policies: built-in, shipped with a card, any folder with one, or a Python class."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import constants, errors, plugins
from airl_mav.core.plugins import announced, digest_of, load_part, names_code, reference
from airl_mav.policy import card as cards
from airl_mav.policy.actions import (
    ActionSpec,
    AnyAction,
    Policy,
    command,
    command_kind,
    discrete_actions,
)
from airl_mav.policy.greedy import GreedyPolicy, GreedySettings
from airl_mav.policy.layouts import Encoded, ablated, boxes, layout_of
from airl_mav.policy.observation import Observation
from airl_mav.policy.observation_spec import camera_mismatch, further_mismatch
from airl_mav.policy.planner import PlannerPolicy, PlannerSettings
from airl_mav.profiles.loading import profiles_dir
from airl_mav.profiles.vehicle import VehicleProfile


class LearnedPolicy:
    """A network with its card. Implements `actions.Policy`.

    A network with memory stores the state of one flight, or of n parallel flights. An object is
    used from the first to the last decision. `with_generator` returns an object for the next
    flight.
    """

    def __init__(
        self,
        card: cards.PolicyCard,
        runtime: cards.Runtime,
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
            raise errors.UsageError(f"ablate = {ablate!r}: accepted: {known}")
        self.card = card
        self._runtime = runtime
        self._rng = rng
        self._ablate = ablate
        self._fitting: tuple[Intrinsics, ...] = ()
        """Intrinsics of the cameras that passed the check."""
        self._memory: cards.Memory | None = None
        """Memory of the network; None before the first decision."""
        self._count = cards.outputs_of(card.actions)
        self._encoder = layout_of(card.observation.layout).encoder()

    @property
    def name(self) -> str:
        """Name on the card."""
        return self.card.name

    @property
    def commands(self) -> constants.CommandKind:
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
                raise errors.UsageError(f"policy {self.card.name}: {reason}")
            self._fitting = looks
        return command(self.card.actions, self.act_batch(self.encode(observation.rows(None)))[0])

    def encode(self, seen: Observation) -> Encoded:
        """Return the arrays of the card's layout for n vehicles; see `layouts.encode_layout`.

        A layout with memory takes the observations of one flight, in order.
        """
        return self._encoder(self.card.observation, seen)

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
        changed, or the outputs have another shape.
        """
        if self._ablate is not None:
            encoded = ablated(encoded, self._ablate)
        n = len(next(iter(encoded.values())))
        outputs = self._remembering(encoded, n) if self.card.state else self._runtime.infer(encoded)
        if outputs.shape != (n, self._count):
            raise ValueError(f"output {outputs.shape}; accepted: {(n, self._count)}")
        return outputs

    def _remembering(self, encoded: Mapping[str, NDArray[Any]], n: int) -> NDArray[np.float32]:
        """Return the outputs of a network with memory, and update the memory."""
        memory = cards.blank_memory(self.card.state, n) if self._memory is None else self._memory
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
    card: cards.PolicyCard | None = None,
    *,
    runtime: cards.RuntimeName = "onnx",
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
    card = card or cards.read_card(folder)
    cards.check_trust(folder, card, trust=trust)
    network = open_network(folder, card, runtime, threads, trust=trust)
    policy = LearnedPolicy(card, network, rng=rng, ablate=ablate)
    blank = {k: np.zeros((1, *box.shape), box.dtype) for k, box in boxes(card.observation).items()}
    try:
        policy.with_generator(np.random.default_rng(0)).outputs(blank)
    except Exception as error:  # Of any type, also from a torch program.
        raise errors.UsageError(f"policy {card.name}: {' '.join(str(error).split())}") from None
    return policy


def open_network(
    folder: Path,
    card: cards.PolicyCard,
    runtime: cards.RuntimeName,
    threads: int,
    *,
    trust: bool = False,
) -> cards.Runtime:
    """Return the network of a card, ready for its first inference; `torch` takes `policy.pt2`.

    `trust` permits the folder's author to run code on this machine: `torch.export.load` falls back
    to unpickling, which runs code from the file. An ONNX model is data, and the policies of this
    package are trusted. A card may name code, too. Raises UsageError as `load_learned`.
    """
    if runtime == "onnx":
        return cards.open_model(folder, card, threads, trust=trust)
    program = cards.read_torch_program(folder, card)
    if not (trust or cards.is_shipped(folder)):
        raise errors.UsageError(
            f"{folder}: its {cards.TORCH_FILE} can run any code on this machine; accepted: with"
            " --trust, if you trust its maker, or with the onnx runtime"
        )
    try:
        return cards.TorchRuntime(program, card.observation, threads, card.state)
    except ValueError as error:
        raise errors.UsageError(f"{folder / cards.TORCH_FILE}: {error}") from None


@dataclass(frozen=True)
class BuiltInPolicy:
    """A policy without a card."""

    description: str
    make: Callable[[float], Policy]
    """Return the policy for a hold time [s]."""
    hold_s: float | None = None
    """Default hold time [s]; None = the scenario's."""


POLICIES: dict[str, BuiltInPolicy] = {
    "greedy": BuiltInPolicy(
        "classical depth-reactive baseline: turn to the goal, steer from near returns, slow down",
        lambda hold_s: GreedyPolicy(GreedySettings(period_s=hold_s)),
    ),
    "planner": BuiltInPolicy(
        "classical planner: a map of the depth images, a path search, tracks of moving obstacles",
        lambda hold_s: PlannerPolicy(PlannerSettings(period_s=hold_s)),
        hold_s=0.1,
    ),
}
"""Built-in policies by name."""


@dataclass(frozen=True)
class PolicyInfo:
    """Description of a policy before it is loaded."""

    name: str
    """Short name, also for folders."""
    description: str
    card: cards.PolicyCard | None = None
    """Policy card; None = not a learned policy."""
    folder: Path | None = None
    """Folder of a learned policy."""
    program: str | None = None
    """FILE.py:CLASS or MODULE:CLASS of a Python policy."""
    asked: constants.CommandKind | None = None
    """Command kind of a policy that another program runs."""

    @property
    def sha256(self) -> str | None:
        """Digest of the policy's file; None for a built-in policy."""
        if self.program is not None:
            return digest_of(self.program)
        return None if self.card is None else self.card.sha256

    @property
    def commands(self) -> constants.CommandKind:
        """Command kind. Raises FieldError if a custom class declares an unknown kind."""
        if self.asked is not None:
            return self.asked
        if self.program is not None:
            return command_kind(_policy_class(self.program))
        return "velocity" if self.card is None else self.card.actions.commands

    @property
    def macs(self) -> int | None:
        """Multiply-accumulates of a decision; None = unknown, as if the layout plans."""
        if self.card is None or layout_of(self.card.observation.layout).remembers:
            return None
        return self.card.macs


def camera_refused(policy: PolicyInfo, vehicle: VehicleProfile) -> str | None:
    """Return why a vehicle's cameras cannot serve a policy, or None if they can, or it is unknown.

    The requirements of Python policies and of other programs are unknown.
    """
    camera = vehicle.camera
    if policy.asked is not None:
        return None
    if policy.card is not None:
        return cards.vehicle_mismatch(policy.card, camera, vehicle.cameras)
    if policy.program is None and camera.kind != "depth":
        return f"{camera.kind} camera; accepted: depth"
    if policy.program is None and camera.yaw_deg != 0.0:
        return f"camera with yaw_deg = {camera.yaw_deg:g}; accepted: 0, one that looks ahead"
    return None


def policy_names() -> list[str]:
    """Return the names of all policies that need no path."""
    return [*POLICIES, *(name for name in _shipped() if name not in POLICIES)]


def find_policy(name: str, *, trust: bool = False) -> PolicyInfo:
    """Return the description of a policy by name, folder path or Python class.

    `trust` permits the folder's author to run code on this machine. Raises UsageError if there is
    no such policy (lists the existing ones), its card does not match, or names untrusted code.
    """
    if names_code(name):
        return PolicyInfo(name.rpartition(":")[2], _summary(name), program=name)
    if name in POLICIES:
        return PolicyInfo(name, POLICIES[name].description)
    folder = _folder(name)
    if folder is None:
        return PolicyInfo(name, _summary(name), program=announced(plugins.POLICIES)[name])
    card = cards.load_card(folder, trust=trust)
    return PolicyInfo(card.name, card.description, card, folder)


def load_policy(
    policy: PolicyInfo | str,
    hold_s: float,
    *,
    runtime: cards.RuntimeName = "onnx",
    threads: int = 1,
    rng: np.random.Generator | None = None,
    ablate: str | None = None,
    trust: bool = False,
) -> Policy:
    """Return a policy, ready to decide, by description, name or folder.

    `hold_s` is the hold time of each action [s]. The keywords are as in `learned.load_learned`;
    only a learned policy takes another runtime or an ablation. Raises UsageError if there is no
    such policy (lists the existing ones), its card does not match, or an option is unsupported.
    """
    known = find_policy(policy, trust=trust) if isinstance(policy, str) else policy
    if known.folder is not None and known.card is not None:
        return load_learned(
            known.folder,
            known.card,
            runtime=runtime,
            threads=threads,
            rng=rng,
            ablate=ablate,
            trust=trust,
        )
    for field, value in (("runtime", None if runtime == "onnx" else runtime), ("ablate", ablate)):
        if value is not None:
            raise errors.FieldError(field, value, f"for a learned policy; {known.name} is none")
    if known.program is not None:
        made: Policy = _policy_class(known.program)()
        return made
    return POLICIES[known.name].make(hold_s)


def _shipped() -> list[str]:
    """Return the names of the shipped policies, sorted."""
    return sorted(
        path.parent.name for path in (profiles_dir() / "policies").glob(f"*/{cards.CARD_FILE}")
    )


def _folder(name: str) -> Path | None:
    """Return the folder of a policy; None for an installed package's. Raises UsageError."""
    if name in _shipped():
        return profiles_dir() / "policies" / name
    path = Path(name)
    if path.is_dir():
        return path
    if reference(plugins.POLICIES, name) is not None:
        return None
    known = ", ".join([*policy_names(), *announced(plugins.POLICIES)])
    raise errors.UsageError(
        f"--policy {name!r}: no such policy; known: {known}"
        f" (or a path to a folder with {cards.ONNX_FILE} and {cards.CARD_FILE}, FILE.py:CLASS or"
        " MODULE:CLASS)"
    )


def _policy_class(name: str) -> Any:
    """Return a policy's class by FILE.py:CLASS, MODULE:CLASS or entry-point name."""
    return load_part(plugins.POLICIES, name, lambda made: callable(getattr(made, "act", None)))


def _summary(name: str) -> str:
    """Return the first line of a policy class's docstring."""
    return (_policy_class(name).__doc__ or "").strip().partition("\n")[0]
