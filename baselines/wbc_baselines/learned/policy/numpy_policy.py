"""Policies computed by NumPy from the tensors of a checkpoint: the means of latent and action, in float32.

An evaluation needs no gradients, and without torch it starts sooner and every worker needs less memory.
"""

from collections.abc import Mapping
from functools import reduce
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.learned.policy.architecture import (
    CENET_WINDOW,
    FEATURES,
    FLOOR,
    HEAD,
    HEADS,
    HIDDEN,
    LAYERS,
    MODEL,
    NORM_FLOOR,
    SIZES,
    flow_of,
    sinusoids,
)
from wbc_baselines.learned.policy.inputs import COMMAND, HISTORY, OBSERVATION, VELOCITY

Array = NDArray[np.float32]
Tensors = Mapping[str, Array]


class NumpyPolicy:
    """Actor and estimator of a checkpoint.

    Carried from step to step are what the encoder keeps of past frames, and the state of the memory.
    """

    def __init__(self, estimator: str, tensors: Tensors) -> None:
        """Take the weights of a policy.

        Args:
            estimator: Name of its estimator.
            tensors: Tensors of its checkpoint, of the names and shapes of `architecture.tensor_shapes`.
        """
        sizes, actor = SIZES[estimator], _part(tensors, "actor")
        context = len(actor["normalizer.mean"]) - OBSERVATION - COMMAND
        self.flow = flow_of(sizes._replace(context=context))
        self._normalize = _Normalizer(_part(actor, "normalizer"))
        self._actor = _MLP(_part(actor, "mlp"), len(HIDDEN) + 1)
        self._encoder = self._memory = None
        if sizes.latent:
            mine = _part(tensors, "estimator")
            self._normalize_frame = _Normalizer(_part(mine, "normalizer"))
            self._encoder = _ENCODERS[estimator](_part(mine, "encoder"))
            self._context = context
            self._memory = _Memory(_part(mine, "memory"), context) if sizes.state else None

    def begin(self, frame: Array) -> Any:
        """See `controller.Engine`."""
        if self._encoder is None:
            return None
        return self._encoder.begin(self._normalize_frame(frame)), np.zeros((len(frame), FEATURES), np.float32)

    def __call__(self, values: Mapping[str, Array], carried: Any) -> tuple[dict[str, Array], Any]:
        """See `controller.Engine`."""
        parts, found = [values["observation"], values["command"]], {}
        if "privileged" in values:
            parts.append(values["privileged"])
        elif self._encoder is not None:
            kept, state = carried
            context, kept = self._encoder(self._normalize_frame(values["term"]), kept)
            if self._memory is not None:
                context, state = self._memory(context, state)
            context = context[:, : self._context]  # e, without the log variance
            parts.append(context)
            found["latent"], carried = context[:, VELOCITY:], (kept, state)
        return {"action": self._actor(self._normalize(np.concatenate(parts, axis=-1)))} | found, carried


class _Encoder(Protocol):
    """What a method makes of the window, one normalized frame (N, 57) at a time."""

    def __init__(self, tensors: Tensors) -> None: ...

    def begin(self, frame: Array) -> Any:
        """What is carried into the first step of episodes that start with this frame, repeated."""
        ...

    def __call__(self, frame: Array, carried: Any) -> tuple[Array, Any]:
        """Features of the window that ends with this frame, and what is carried into the next step."""
        ...


class _NewestFrame:
    """See `estimators.gru.NewestFrame`."""

    def __init__(self, tensors: Tensors) -> None:
        self._linear = _Linear(tensors)

    def begin(self, frame: Array) -> None:
        return None

    def __call__(self, frame: Array, carried: None) -> tuple[Array, None]:
        return self._linear(frame), None


class _NewestFrames:
    """See `estimators.cenet.NewestFrames`; the frames (N, CENET_WINDOW, 57) are carried."""

    def __init__(self, tensors: Tensors) -> None:
        self._mlp = _MLP(tensors, 3)

    def begin(self, frame: Array) -> Array:
        return frame[:, None].repeat(CENET_WINDOW, axis=1)

    def __call__(self, frame: Array, carried: Array) -> tuple[Array, Array]:
        window = np.concatenate([carried[:, 1:], frame[:, None]], axis=1)
        return self._mlp(window.reshape(len(frame), -1)), window


class _WindowEncoder:
    """See `estimators.window.WindowEncoder`.

    Token, query, key and value of the first layer are linear in frame and position: x = E f + p, q = Q x. So
    those of the frames alone (N, HISTORY, 4 MODEL) are carried, and only the newest frame is multiplied.
    """

    def __init__(self, tensors: Tensors) -> None:
        first, last = (_part(tensors, f"layers.{k}") for k in range(LAYERS))
        # the identity for the token itself; the factor of attention is part of the query
        all_of = np.concatenate([np.eye(MODEL), first["qkv.weight"].astype(np.float64)])
        bias = np.concatenate([np.zeros(MODEL), first["qkv.bias"].astype(np.float64)])
        scale = np.repeat([1.0, HEAD**-0.5, 1.0, 1.0], MODEL)
        positions = sinusoids(HISTORY, MODEL) + tensors["embed.bias"].astype(np.float64)
        self._of_frame = (scale[:, None] * (all_of @ tensors["embed.weight"])).astype(np.float32)
        self._of_position = (scale * (positions @ all_of.T + bias)).astype(np.float32)
        self._first, self._last = _Layer(first), _Layer(last)
        self._read_out = _Linear(_part(tensors, "read_out"))

    def begin(self, frame: Array) -> Array:
        return (frame @ self._of_frame.T)[:, None].repeat(HISTORY, axis=1)

    def __call__(self, frame: Array, carried: Array) -> tuple[Array, Array]:
        carried = np.concatenate([carried[:, 1:], (frame @ self._of_frame.T)[:, None]], axis=1)
        token, *projected = np.split(carried + self._of_position, 4, axis=-1)
        x = self._first.finish(token, _attend(*projected))
        return self._read_out(self._last.finish(x[:, -1], self._last.attend_last(x))), carried


class _Layer:
    """See `estimators.window.Layer`."""

    def __init__(self, tensors: Tensors) -> None:
        self._query = _Linear({name: tensors[f"qkv.{name}"][:MODEL] for name in ("weight", "bias")})
        self._key, self._value = tensors["qkv.weight"].reshape(3, HEADS, HEAD, MODEL)[1:]
        self._value_bias = tensors["qkv.bias"][2 * MODEL :]
        linear = {name: _Linear(_part(tensors, name)) for name in ("out", "widen", "narrow")}
        self._out, self._widen, self._narrow = linear.values()
        self._norm1, self._norm2 = (_Norm(_part(tensors, name)) for name in ("norm1", "norm2"))

    def attend_last(self, x: Array) -> Array:
        """Attention of the last token to all tokens (N, T, MODEL), as in `estimators.window.Layer`."""
        query = self._query(x[:, -1]) * np.float32(HEAD**-0.5)
        query = query.reshape(-1, HEADS, HEAD).swapaxes(0, 1)  # (HEADS, N, HEAD)
        asked = (query @ self._key).swapaxes(0, 1)  # (N, HEADS, MODEL)
        share, total = _exponentials(asked @ x.swapaxes(1, 2))  # (N, HEADS, T)
        gathered = ((share @ x) / total).swapaxes(0, 1) @ self._value.swapaxes(1, 2)  # (HEADS, N, HEAD)
        return gathered.swapaxes(0, 1).reshape(-1, MODEL) + self._value_bias

    def finish(self, x: Array, attended: Array) -> Array:
        """The layer's output (..., MODEL) for its input x and what the tokens attended to."""
        x = self._norm1(x + self._out(attended))
        wide = self._widen(x)
        return self._norm2(x + self._narrow(np.maximum(wide, 0, out=wide)))


class _Memory:
    """See `estimators.memory.Memory`; of e only the first columns are computed."""

    def __init__(self, tensors: Tensors, columns: int) -> None:
        weights = {name: _part(tensors, "cell")[f"{name}_ih"] for name in ("weight", "bias")}
        self._of_input = _Linear(weights)
        self._of_state = _Linear({name: _part(tensors, "cell")[f"{name}_hh"] for name in weights})
        self._out = _Linear({name: tensors[f"out.{name}"][:columns] for name in weights})
        self._columns = columns

    def __call__(self, u: Array, state: Array) -> tuple[Array, Array]:
        reset, update, new = np.split(self._of_input(u), 3, axis=-1)
        reset_state, update_state, new_state = np.split(self._of_state(state), 3, axis=-1)
        new = np.tanh(new + _sigmoid(reset + reset_state) * new_state)
        state = new + _sigmoid(update + update_state) * (state - new)
        return u[:, : self._columns] + self._out(state), state


class _Normalizer:
    """See `normalizer.Normalizer`."""

    def __init__(self, tensors: Tensors) -> None:
        self._mean, self._deviation = tensors["mean"], tensors["std"] + np.float32(FLOOR)

    def __call__(self, x: Array) -> Array:
        x = x - self._mean
        x /= self._deviation
        return x


class _Linear:
    def __init__(self, tensors: Tensors) -> None:
        self._weight, self._bias = tensors["weight"].T, tensors["bias"]

    def __call__(self, x: Array) -> Array:
        # one product for all tokens: NumPy would compute a stack of matrices one by one
        found = x.reshape(-1, x.shape[-1]) @ self._weight
        found += self._bias
        return found.reshape(*x.shape[:-1], -1)


class _MLP:
    """Linear layers with ELU in between."""

    def __init__(self, tensors: Tensors, layers: int) -> None:
        # every other module is an activation
        self._first, *self._others = (_Linear(_part(tensors, str(2 * k))) for k in range(layers))

    def __call__(self, x: Array) -> Array:
        x = self._first(x)
        for linear in self._others:
            x = linear(np.maximum(x, 0) + np.expm1(np.minimum(x, 0)))
        return x


class _Norm:
    """Layer norm."""

    def __init__(self, tensors: Tensors) -> None:
        self._weight, self._bias = tensors["weight"], tensors["bias"]

    def __call__(self, x: Array) -> Array:
        x = x - x.mean(axis=-1, keepdims=True, dtype=np.float32)
        variance = np.einsum("...i,...i->...", x, x)[..., None] / np.float32(MODEL)
        x /= np.sqrt(variance + np.float32(NORM_FLOOR))
        x *= self._weight
        x += self._bias
        return x


def _attend(query: Array, key: Array, value: Array) -> Array:
    """Attention of every token to all tokens, (N, T, MODEL) each."""
    q, k, v = (part.reshape(*part.shape[:2], HEADS, HEAD).swapaxes(1, 2) for part in (query, key, value))
    share, total = _exponentials(q @ k.swapaxes(-1, -2))  # (N, HEADS, T, T)
    return ((share @ v) / total).swapaxes(1, 2).reshape(query.shape)


def _exponentials(scores: Array) -> tuple[Array, Array]:
    """Numerators (..., T) and denominator (..., 1) of a softmax.

    Over a short last axis, maxima of its columns and a product with ones are faster than reductions.
    """
    length = scores.shape[-1]
    scores -= reduce(np.maximum, (scores[..., k] for k in range(length)))[..., None]
    np.exp(scores, out=scores)
    total = scores.reshape(-1, length) @ np.ones((length, 1), np.float32)
    return scores, total.reshape(*scores.shape[:-1], 1)


def _sigmoid(x: Array) -> Array:
    half = np.float32(0.5)
    return half + half * np.tanh(half * x)


def _part(tensors: Tensors, name: str) -> dict[str, Array]:
    """The tensors of one module, by their names in it."""
    return {key.removeprefix(f"{name}."): v for key, v in tensors.items() if key.startswith(f"{name}.")}


_ENCODERS: dict[str, type[_Encoder]] = {
    "cenet": _NewestFrames,
    "gru": _NewestFrame,
    "transformer": _WindowEncoder,
    "transformer_gru": _WindowEncoder,
}
