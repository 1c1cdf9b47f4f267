"""Derivatives that the adjoint does not have are refused in a sentence that names the remedy.

JAX says of a function with an adjoint of its own no more than that forward mode does not apply. A
mark is the identity, and nothing of it is compiled; its tangent goes through another identity,
which refuses to be evaluated, or to be a function that is transposed.
"""

from collections.abc import Callable
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir, partial_eval
from jaxtyping import Array, PyTree

FORWARD = (
    "a rollout is differentiated in reverse mode by its adjoint, as by jax.grad; forward mode, as "
    "jax.jvp and jax.jacfwd, needs rollout(..., adjoint=False)"
)
TWICE = (
    "a rollout is differentiated once by its adjoint, or twice without self-contact by jax.hessian "
    "or jax.jvp of jax.grad; other second derivatives need rollout(..., adjoint=False)"
)


def reverse_only(tree: PyTree[Any]) -> PyTree[Any]:
    """The same arrays; forward mode raises a `TypeError`."""
    return _marked(_reverse_only, tree)


def forward_only(tree: PyTree[Any]) -> PyTree[Any]:
    """The same arrays, of a derivative; another in reverse mode raises a `TypeError`."""
    return _marked(_FORWARD_ONLY.bind, tree)


def constant(tree: PyTree[Any]) -> PyTree[Any]:
    """The same arrays, of a derivative; another in any mode raises a `TypeError`."""
    return _marked(_CONSTANT.bind, tree)


def _marked(mark: Callable[[Array], Array], tree: PyTree[Any]) -> PyTree[Any]:
    """Leaf by leaf, so that what does not vary stays a constant."""
    return jax.tree.map(
        lambda leaf: mark(leaf) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree
    )


def _identity(name: str) -> Primitive:
    primitive = Primitive(name)
    primitive.def_abstract_eval(lambda array: array)
    primitive.def_impl(lambda array: array)
    batching.defvectorized(primitive)
    mlir.register_lowering(primitive, lambda _, array: [array])
    ad.deflinear2(primitive, lambda bar, _: [bar])
    return primitive


def _refuse(text: str) -> Callable[..., NoReturn]:
    def refuse(*_: Any, **__: Any) -> NoReturn:
        raise TypeError(text)

    return refuse


_NOT_EVALUATED = Primitive("not_evaluated")
_NOT_EVALUATED.def_abstract_eval(lambda tangent, _: tangent)
_NOT_EVALUATED.def_impl(_refuse(FORWARD))
ad.primitive_jvps[_NOT_EVALUATED] = _refuse(FORWARD)
ad.primitive_transposes[_NOT_EVALUATED] = lambda bar, *_: [bar, None]
mlir.register_lowering(_NOT_EVALUATED, _refuse(FORWARD))


def _batch(arrays: tuple[Array, Array], axes: tuple[Any, Any]) -> tuple[Array, Any]:
    """A batch of tangents alone is that of `jax.jacfwd`."""
    if axes[1] is None:
        _refuse(FORWARD)()
    return _NOT_EVALUATED.bind(*arrays), axes[0]


batching.primitive_batchers[_NOT_EVALUATED] = _batch

_NOT_TRANSPOSED = _identity("not_transposed")
partial_eval.custom_partial_eval_rules[_NOT_TRANSPOSED] = _refuse(TWICE)


# As the adjoint itself, this is not part of a derivative in reverse mode; primitives are.
@jax.custom_jvp
def _reverse_only(array: Array) -> Array:
    return array


@_reverse_only.defjvp
def _reverse_only_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    nothing = primals[0].ravel()[:0]  # has the axis of a batch that the array has
    return primals[0], _NOT_EVALUATED.bind(tangents[0], nothing)


_FORWARD_ONLY = _identity("forward_only")
ad.defjvp(_FORWARD_ONLY, lambda tangent, _: _NOT_TRANSPOSED.bind(tangent))

_CONSTANT = _identity("constant")
ad.defjvp(_CONSTANT, _refuse(TWICE))
