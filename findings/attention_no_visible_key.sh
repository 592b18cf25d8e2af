#!/usr/bin/env bash
# One would guess: a query whose keys are all masked reads nothing, in every attention.
# What happens: torch's `scaled_dot_product_attention` gives 0; jax's `dot_product_attention` the mean of all values,
# the hidden ones; torch's `MultiheadAttention` nan, or 0 with `need_weights=False`.
# For this field: padding before an episode, a window of missing frames or a query before the first visible step makes
# such rows. Ported to jax, a model reads what a mask should hide, padding and future included, and training gets
# better for it. Let every query see one constant key, or zero its output.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" jax==0.10.2 numpy==2.4.6
JAX_PLATFORMS=cpu OMP_NUM_THREADS=1 "$tmp/venv/bin/python" -W ignore - << 'PY'
import jax
import jax.numpy as jnp
import numpy as np
import torch

print("torch", torch.__version__, "jax", jax.__version__)
torch.manual_seed(0)
time = 5
x = torch.randn(1, time, 4)
visible = torch.ones(time, time, dtype=torch.bool).tril(-1)  # strictly earlier steps: none for the first
other = x.clone()
other[:, 1:] += 1  # only the future of the first query changes


def torch_attention(x):
    return torch.nn.functional.scaled_dot_product_attention(x[:, None], x[:, None], x[:, None], attn_mask=visible)[0, 0]


def jax_attention(x):
    x = jnp.asarray(x.numpy())[:, :, None]  # (batch, time, heads, width)
    return jax.nn.dot_product_attention(x, x, x, mask=jnp.asarray(visible.numpy())[None, None])[0, :, 0]


def shorten(row):
    return [round(float(number), 3) for number in row]


layer = torch.nn.MultiheadAttention(4, 1, bias=False, batch_first=True)


def module(x, **options):
    with torch.no_grad():
        return layer(x, x, x, attn_mask=~visible, **options)[0][0]


shown = {
    "scaled_dot_product_attention": torch_attention,
    "jax.nn.dot_product_attention": jax_attention,
    "MultiheadAttention": module,
    "MultiheadAttention(need_weights=False)": lambda x: module(x, need_weights=False),
}
first = {name: np.asarray(attention(x))[0] for name, attention in shown.items()}
after = {name: np.asarray(attention(other))[0] for name, attention in shown.items()}
for name, row in first.items():
    print(f"{name}: {shorten(row)}; with another future {shorten(after[name])}")
print("mean of the values:", shorten(x[0].mean(0).numpy()))
plain, jaxed, weighted, unweighted = first.values()
assert not plain.any() and not unweighted.any(), "torch reads something"
assert np.isnan(weighted).all(), "the module is finite"
assert np.allclose(jaxed, x[0].mean(0), atol=1e-5), "jax reads something else"
assert not np.allclose(jaxed, after["jax.nn.dot_product_attention"]), "jax does not read the future"
PY
