"""Workarounds for XLA's CPU compiler."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gen2d.xla import materialize, on_cpu, runtime_one


def test_materialize_divides_within_its_context_only_and_changes_no_bit():
    values = jnp.asarray(np.random.default_rng(0).normal(size=100), jnp.float32)

    def within(x: jax.Array) -> jax.Array:
        with runtime_one(1.0 + jax.lax.stop_gradient(jnp.maximum(-jnp.max(jnp.abs(x)), 0.0))):
            return materialize({"x": x})["x"]

    np.testing.assert_array_equal(jax.jit(within)(values), values)
    assert ("div" in str(jax.make_jaxpr(within)(values))) == on_cpu()
    assert materialize(values) is values


def test_the_context_is_left_when_its_trace_fails():
    with pytest.raises(ValueError, match="stop"), runtime_one(jnp.ones(())):
        raise ValueError("stop")
    values = jnp.ones(3)
    assert materialize(values) is values
