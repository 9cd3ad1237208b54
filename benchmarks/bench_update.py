"""One fitted epoch of the paper's model: forward and backward nets, 256 samples per member."""

import typing

import jax
import pytest
from workloads import make_fit, update_flop

from headway.config import FittingConfig, MultiHeadedConfig, Precision
from headway.models.fitting import fit_epoch

MODEL = MultiHeadedConfig()


@pytest.mark.parametrize("precision", typing.get_args(Precision))
def test_epoch(precision, timed, report):
    fitting = FittingConfig(precision=precision)
    state, setup, data = make_fit(10, 100, MODEL, fitting)
    key = jax.random.key(2)
    _, stats = fit_epoch(state, setup, data, independent=False, key=key)
    updates = int(stats.updates)
    timing = timed(lambda: fit_epoch(state, setup, data, independent=False, key=key), rounds=3)
    each = timing.seconds / updates
    report.add(
        f"fitted epoch of {updates} updates, heads assigned, {precision}", timing.seconds, "s"
    )
    report.add(
        f"  one update of {MODEL.num_members} x {fitting.batch_size}: its share",
        1e3 * each,
        "ms",
        **timing.rate.ratio(update_flop(state.model, fitting.batch_size), each),
        key=f"update-{precision}",
    )
    report.add("  updates per second", 1 / each, "/s", key=f"updates-{precision}")
