"""Readers answer any bytes at all with values or with a HeadwayError."""

import json
import math
from pathlib import Path

import damage
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headway import settings as config_settings
from headway.config import Config
from headway.errors import ConfigError, RunError
from headway.storage import arrays, files, records
from headway.storage.tables import EVALUATION_COLUMNS, EpisodeRow, check_metrics, parse_rows

MANY = settings(max_examples=200)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)
NAMES = st.sampled_from(config_settings.setting_names(Config(env="pendulum")))
PATH = Path("evaluation.csv")
CELLS = st.one_of(
    st.text(max_size=12),
    st.integers().map(str),
    st.floats().map(repr),
    st.sampled_from(["length=1", "length=1 mass=nan", "=", "a=b=c", '"', "\r", "\0", "1e999"]),
)


def taken(error_type, read, *args):
    """What was read, or None when it was refused in one short line."""
    try:
        return read(*args)
    except error_type as error:
        text = str(error)
    assert "\n" not in text
    assert len(text) < 2000
    return None


@MANY
@given(changes=st.dictionaries(NAMES, JSON, min_size=1, max_size=3))
def test_any_settings(changes):
    values = config_settings.to_dict(Config(env="pendulum"))
    for name, value in changes.items():
        section, _, field = name.rpartition(".")
        (values[section] if section else values)[field] = value
    config = taken(ConfigError, config_settings.from_dict, values)
    if config is not None:
        assert config_settings.from_dict(config_settings.to_dict(config)) == config


@MANY
@given(content=st.binary(max_size=200) | JSON.map(lambda value: json.dumps(value).encode()))
def test_any_json(content):
    value = taken(ValueError, files.parse_json, content)
    assert files.parse_json(files.format_json(value)) == value


@MANY
@given(rows=st.lists(st.lists(CELLS, min_size=8, max_size=10), max_size=3), header=st.booleans())
def test_any_table_of_test_episodes(rows, header):
    lines = [",".join(EVALUATION_COLUMNS)] * header + [",".join(row) for row in rows]
    content = "\n".join(lines).encode("utf-8", "replace")
    table = records.parse_csv(PATH, content, EVALUATION_COLUMNS)
    found = taken(RunError, parse_rows, PATH, table, EpisodeRow.from_csv)
    assert all(math.isfinite(row.episode_return) for row in found or ())


@MANY
@given(content=st.binary(max_size=300))
def test_any_bytes_as_a_table(content):
    taken(RunError, list, records.parse_csv(PATH, content, EVALUATION_COLUMNS))


@MANY
@given(rows=st.lists(JSON | st.fixed_dictionaries({"iteration": st.just(0), "evaluation": JSON})))
def test_any_metrics(rows):
    taken(RunError, check_metrics, Path("metrics.jsonl"), rows)


SPEC = st.fixed_dictionaries(
    {
        "dtype": st.sampled_from(["F32", "F64", "I32", "BOOL", "BF16", "object", "f32"]) | JSON,
        "shape": st.lists(st.integers(-2, 5) | st.sampled_from([2**31, 2**62]), max_size=4) | JSON,
        "data_offsets": st.lists(st.integers(-4, 64), max_size=3) | JSON,
    }
)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "arrays.safetensors"


@MANY
@given(
    header=st.dictionaries(st.text(max_size=4), SPEC, max_size=3) | JSON,
    data=st.binary(max_size=64),
    length=st.none() | st.integers(0, 2**64 - 1),
)
def test_any_array_header(file, header, data, length):
    file.write_bytes(damage.with_header(json.dumps(header).encode(), data, length))
    check_reading(file)


@MANY
@given(content=st.binary(max_size=200))
def test_any_bytes_as_arrays(file, content):
    file.write_bytes(content)
    check_reading(file)


def check_reading(file):
    found = taken(RunError, arrays.load_arrays, file)
    assert sum(array.nbytes for array in (found or {}).values()) <= file.stat().st_size


@MANY
@given(
    shapes=st.dictionaries(
        st.text(st.characters(codec="ascii"), min_size=1, max_size=5),
        st.lists(st.integers(0, 4), max_size=3),
        min_size=1,
        max_size=4,
    )
)
def test_what_was_saved_is_read(file, shapes):
    made = {name: np.random.default_rng(0).normal(size=shape) for name, shape in shapes.items()}
    arrays.save_arrays(file, made)
    found = arrays.load_arrays(file)
    assert set(found) == set(made)
    assert all(np.array_equal(found[name], made[name]) for name in made)
