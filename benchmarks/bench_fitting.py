"""One fitted epoch of the paper's model: forward and backward nets, 256 samples per member."""

import jax
from workloads import make_fit, update_flop

from headway.config import FittingConfig, ModelConfig
from headway.models.fitting import fit_epoch

MODEL = ModelConfig()
FITTING = FittingConfig()


def test_epoch(timed, report):
    state, setup, data = make_fit(10, 100, MODEL, FITTING)
    key = jax.random.key(2)
    _, stats = fit_epoch(state, setup, data, independent=False, key=key)
    updates = int(stats.updates)
    timing = timed(lambda: fit_epoch(state, setup, data, independent=False, key=key), rounds=3)
    each = timing.seconds / updates
    report.add(f"fitted epoch of {updates} updates, heads assigned", timing.seconds, "s")
    report.add(
        f"  one update of {MODEL.num_members} x {FITTING.batch_size}: its share",
        1e3 * each,
        "ms",
        **timing.rate.ratio(update_flop(state.model, FITTING.batch_size), each),
        key="update",
    )
    report.add("  updates per second", 1 / each, "/s", key="updates")
