"""Position of the batch axis: last inside time steps, whatever the axis of `vmap`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


def batch_last(
    fn: Callable[[PyTree[Any], PyTree[Any]], PyTree[Any]],
) -> Callable[[PyTree[Any], PyTree[Any]], PyTree[Any]]:
    """The function, with the batch as last axis under `vmap` over its second argument.

    Args:
        fn: function of an argument common to all samples, and of one per sample; pure JAX. An
            additional last axis on every leaf of the second argument must give one on every leaf
            of the result. Under `vmap` over the first argument, too, JAX batches it as usual.
    """
    wrapped = jax.custom_batching.custom_vmap(fn)

    @wrapped.def_vmap
    def over_batch(size: int, batched: Any, shared: Any, own: Any) -> tuple[Any, Any]:
        if not any(jax.tree.leaves(batched)):  # a batch of tangents alone, as in a Hessian
            result = fn(shared, own)
            return result, jax.tree.map(lambda _: False, result)
        if any(jax.tree.leaves(batched[0])):
            axes = jax.tree.map(lambda each: 0 if each else None, batched)
            result = jax.vmap(fn, axes)(shared, own)
        else:

            def last(array: Array, has_batch: bool) -> Array:
                array = array if has_batch else jnp.broadcast_to(array[None], (size, *array.shape))
                return jnp.moveaxis(array, 0, -1)

            result = fn(shared, jax.tree.map(last, own, batched[1]))
            result = jax.tree.map(lambda array: jnp.moveaxis(array, -1, 0), result)
        return result, jax.tree.map(lambda _: True, result)

    return wrapped
