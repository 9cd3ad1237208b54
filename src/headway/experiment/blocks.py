"""Going through the data in blocks of whole episodes, so that memory holds blocks, not the data.

Data of one block are laid out once and stay on the device for a whole fit. Larger data are
dealt out at random in every epoch, into as few blocks as hold them, and a background thread
lays out the next block while the device learns from the current one. Either way an epoch shows
every sample once, and the statistics are those of all data. What several blocks change:

- Samples are shuffled within their block, and the last batch of each block may be partly empty.
- Heads are assigned block by block, each with the model of that moment, not once per epoch.
- With `bootstrap`, a member draws with replacement within each episode, not from all data;
  its draws are still made once per fit.
"""

import dataclasses
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from headway.config import Config, FittingConfig
from headway.data import Episodes, Samples, Trajectory
from headway.experiment.methods import told_sim_params
from headway.models.dynamics import Statistics
from headway.models.fitting import (
    FitData,
    FitSetup,
    FitState,
    fit_epoch,
    make_data,
)
from headway.models.updates import EpochStats

Item = TypeVar("Item")
Made = TypeVar("Made")
State = TypeVar("State")


class Layout(NamedTuple):
    """Sizes of a block's padded arrays; the same all through a run."""

    num_episodes: int
    episode_length: int
    sim_param_names: tuple[str, ...] = ()
    """The true simulator parameters that the model is told."""

    @classmethod
    def of(cls, config: Config, episode_length: int) -> "Layout":
        """Room for the whole run, or for as many episodes as a block may hold.

        Args:
            config: Settings of the run; `check_block` has passed them.
            episode_length: Most transitions of an episode; shorter ones are padded to it.
        """
        run = config.collection.num_iterations * config.collection.num_episodes
        num_episodes = min(run, config.fitting.block_transitions // episode_length)
        return cls(num_episodes, episode_length, told_sim_params(config))

    def episodes(self, trajectories: list[Trajectory]) -> Episodes:
        """Lay out at most `num_episodes` trajectories."""
        return Episodes.pad(
            trajectories, self.num_episodes, self.episode_length, self.sim_param_names
        )

    def samples(self, trajectories: list[Trajectory], fitting: FittingConfig) -> Samples:
        """List the samples of at most `num_episodes` trajectories."""
        return Samples.table(
            [len(trajectory) for trajectory in trajectories],
            fitting.future_length,
            capacity=self.num_episodes * self.episode_length * fitting.future_length,
            drop_first=fitting.drop_first_anchor,
        )

    def in_order(
        self, trajectories: list[Trajectory]
    ) -> Iterator[tuple[list[Trajectory], Episodes]]:
        """Go through all trajectories, a block at a time."""
        for first in range(0, len(trajectories), self.num_episodes):
            part = trajectories[first : first + self.num_episodes]
            yield part, self.episodes(part)


class Block(NamedTuple):
    """What is fitted in one go."""

    data: FitData
    key: PRNGKeyArray
    """Shuffles the samples."""


@dataclasses.dataclass(frozen=True)
class BlockedData:
    """The data of one fit.

    Attributes:
        trajectories: All of them; memory-mapped ones are read when their block is laid out.
        layout: Sizes of a block.
        statistics: Normalisers fitted to all trajectories.
        setup: Task and settings.
        num_members: Networks in the ensemble.
        key: Draws the bootstrap samples.
    """

    trajectories: list[Trajectory]
    layout: Layout
    statistics: Statistics
    setup: FitSetup
    num_members: int
    key: PRNGKeyArray

    @property
    def num_blocks(self) -> int:
        """Blocks that hold all trajectories."""
        return -(-len(self.trajectories) // self.layout.num_episodes)

    def stream(
        self, epochs: int, key: PRNGKeyArray, *, first: int = 0
    ) -> Generator[Block, None, None]:
        """The blocks of all epochs in a row, `num_blocks` in each epoch.

        Let go of a block before taking the next: then at most two exist at a time.

        Args:
            epochs: Passes over the data.
            key: Deals out the episodes and shuffles the samples.
            first: Begin with this epoch, because those before it are done.
        """
        keys = (jax.random.fold_in(key, epoch) for epoch in range(first, epochs))
        if self.num_blocks > 1:
            return made_ahead(self._block, (deal for key in keys for deal in self._deals(key)))
        data = self._lay_out(self.trajectories)
        return (Block(data, key) for key in keys)

    def _deals(self, key: PRNGKeyArray) -> Iterator[tuple[Int[np.ndarray, " row"], PRNGKeyArray]]:
        """Deal all episodes into blocks of nearly equal numbers of them."""
        dealt = np.random.default_rng(_seed(key)).permutation(len(self.trajectories))
        for index, rows in enumerate(np.array_split(dealt, self.num_blocks)):
            yield rows, jax.random.fold_in(key, index)

    def _block(self, deal: tuple[Int[np.ndarray, " row"], PRNGKeyArray]) -> Block:
        rows, key = deal
        data = self._lay_out([self.trajectories[row] for row in rows])
        if self.setup.config.bootstrap and self.num_members > 1:
            data = data._replace(rows=jnp.asarray(self._draws(data.samples, rows)))
        return Block(data, key)

    def _lay_out(self, trajectories: list[Trajectory]) -> FitData:
        fitting = self.setup.config
        return make_data(
            self.layout.episodes(trajectories),
            self.layout.samples(trajectories, fitting),
            self.statistics,
            fitting,
            num_members=self.num_members,
            key=self.key,
        )

    def _draws(
        self, samples: Samples, rows: Int[np.ndarray, " row"]
    ) -> Int[np.ndarray, "member sample"]:
        """Draw samples with replacement within each episode, the same whatever block it is in."""
        used = np.asarray(samples.episode)[: int(samples.count)]
        sizes = np.bincount(used, minlength=len(rows))
        draws = np.zeros((self.num_members, len(samples.episode)), np.int32)
        seed = _seed(self.key)
        for row, size, end in zip(rows, sizes, np.cumsum(sizes), strict=True):
            uniform = np.random.default_rng([*seed, row]).random((self.num_members, size))
            draws[:, end - size : end] = end - size + (size * uniform).astype(np.int32)
        return draws


def fit_blocks(
    state: FitState,
    setup: FitSetup,
    blocks: Iterable[Block],
    *,
    independent: bool,
) -> tuple[FitState, EpochStats]:
    """Fit one block after the other.

    Args:
        state: Networks and optimiser.
        setup: Task and settings.
        blocks: Those of one epoch.
        independent: Train every head on all samples.

    Returns:
        The new state, and averages over all updates.
    """

    def fit(state: FitState, data: FitData, key: PRNGKeyArray) -> tuple[FitState, EpochStats]:
        return fit_epoch(state, setup, data, independent=independent, key=key)

    return fit_each(state, blocks, fit)


def fit_each(
    state: State,
    blocks: Iterable[Block],
    fit: Callable[[State, FitData, PRNGKeyArray], tuple[State, EpochStats]],
) -> tuple[State, EpochStats]:
    """Fit one block after the other, by any procedure.

    Args:
        state: What fitting changes.
        blocks: Those of one epoch.
        fit: Goes once through the data of a block.

    Returns:
        The new state, and averages over all updates.
    """
    found = []
    for block in blocks:
        state, stats = fit(state, block.data, block.key)
        found.append(jax.device_get(stats))  # waits until the device is done with the block
        del block
    return state, merge_stats(found)


def merge_stats(parts: Sequence[EpochStats]) -> EpochStats:
    """Average over the updates of all parts that were not skipped."""
    loss, forward_loss, skipped, updates = (np.stack(column) for column in zip(*parts, strict=True))
    taken = (updates - skipped).astype(np.float64)
    total = max(taken.sum(), 1.0)
    averages = (taken * loss).sum() / total, (taken * forward_loss).sum() / total
    return EpochStats(*averages, skipped.sum(), updates.sum())


def made_ahead(make: Callable[[Item], Made], items: Iterable[Item]) -> Generator[Made, None, None]:
    """Make something of each item, one ahead of its use, in a background thread.

    At most two results exist at a time, if the caller lets go of one before taking the next.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="headway-blocks") as pool:
        futures = (pool.submit(make, item) for item in items)
        coming = next(futures, None)
        while coming is not None:
            ready = coming.result()
            coming = next(futures, None)
            yield ready
            del ready


def _seed(key: PRNGKeyArray) -> list[int]:
    """A key as what seeds NumPy."""
    return np.asarray(jax.random.key_data(key)).tolist()
