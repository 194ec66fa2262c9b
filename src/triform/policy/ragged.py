"""Attention on rows of different lengths, without padding: kernels for the CPU, forwards and backwards.

A row is a list of queries that attend to a list of keys; every list holds indices into packed tokens. Occupancy maps
have from 1 to about 100 tokens, so that padding a mini-batch to its longest row would quadruple the work. Each row and
head is gathered into matrices without gaps, which BLAS multiplies.

Queries, keys and values are arrays of shape (tokens, heads, width); ``*_head`` is the place of the first head that is
meant, so that one array may hold all three. The weights of a row are a matrix (queries, keys); those of all heads and
rows lie flat one behind the other, row by row.
"""

from __future__ import annotations

import numpy as np

from triform.kernels import kernel

# Sums may be taken in vectors only where nothing is written: loops that write are compiled twice, with vectors and, for
# arrays that might overlap, without, and which one runs depends on where memory lies. Both must round alike.
_SUMS = {"reassoc", "contract", "nsz"}


@kernel(fastmath=_SUMS)
def _sum(a):
    total = a.dtype.type(0.0)
    for j in range(a.shape[0]):
        total += a[j]
    return total


@kernel(fastmath=_SUMS)
def _dot(a, b):
    total = a.dtype.type(0.0)
    for j in range(a.shape[0]):
        total += a[j] * b[j]
    return total


@kernel
def _longest(first):
    longest = 0
    for m in range(first.shape[0] - 1):
        longest = max(longest, first[m + 1] - first[m])
    return longest


@kernel
def _gather(tokens, rows, first, last, head, store):
    """The rows of ``tokens`` named by ``rows[first:last]``, copied to the front of ``store``: (last - first, width)."""
    width = tokens.shape[2]
    out = store[: (last - first) * width].reshape(last - first, width)
    for j in range(first, last):
        row = rows[j]
        for d in range(width):
            out[j - first, d] = tokens[row, head, d]
    return out


@kernel
def _scatter(values, rows, first, head, out):
    """Add the rows of ``values`` to those of ``out`` that ``rows`` names from ``first`` on."""
    for j in range(values.shape[0]):
        row = rows[first + j]
        for d in range(values.shape[1]):
            out[row, head, d] += values[j, d]


@kernel
def attention_scores(q, k, q_rows, q_first, k_rows, k_first, heads, k_head, scale, weights):
    """Write ``scale q k^T``, less the largest of each query, to ``weights``, flat; their exponentials are at most 1."""
    width = q.shape[2]
    queries = np.empty(_longest(q_first) * width, dtype=q.dtype)
    keys = np.empty(_longest(k_first) * width, dtype=q.dtype)
    at = 0
    for m in range(q_first.shape[0] - 1):
        rows, columns = q_first[m + 1] - q_first[m], k_first[m + 1] - k_first[m]
        for h in range(heads):
            own = _gather(q, q_rows, q_first[m], q_first[m + 1], h, queries)
            other = _gather(k, k_rows, k_first[m], k_first[m + 1], k_head + h, keys)
            scores = weights[at : at + rows * columns].reshape(rows, columns)
            at += rows * columns
            np.dot(own, other.T, scores)
            for i in range(rows):
                top = scores[i, 0]
                for j in range(1, columns):
                    top = max(top, scores[i, j])
                for j in range(columns):
                    scores[i, j] = (scores[i, j] - top) * scale


@kernel
def attend(v, q_rows, q_first, k_rows, k_first, heads, v_head, weights, out):
    """Divide ``weights`` by their sum over the keys, and add what they make of the values to ``out``."""
    width = v.shape[2]
    values = np.empty(_longest(k_first) * width, dtype=v.dtype)
    mixed = np.empty(_longest(q_first) * width, dtype=v.dtype)
    at = 0
    for m in range(q_first.shape[0] - 1):
        rows, columns = q_first[m + 1] - q_first[m], k_first[m + 1] - k_first[m]
        for h in range(heads):
            shares = weights[at : at + rows * columns].reshape(rows, columns)
            at += rows * columns
            for i in range(rows):
                share = v.dtype.type(1.0) / _sum(shares[i])
                for j in range(columns):
                    shares[i, j] *= share
            seen = _gather(v, k_rows, k_first[m], k_first[m + 1], v_head + h, values)
            sums = mixed[: rows * width].reshape(rows, width)
            np.dot(shares, seen, sums)
            _scatter(sums, q_rows, q_first[m], h, out)


@kernel
def attend_backward(
    q, k, v, q_rows, q_first, k_rows, k_first, heads, k_head, v_head, scale, weights, grad, d_q, d_k, d_v
):
    """Add the gradients of attention to ``d_q``, ``d_k`` and ``d_v``, laid out like ``q``, ``k`` and ``v``."""
    width, most_queries, most_keys = q.shape[2], _longest(q_first), _longest(k_first)
    q_store, grad_store, d_q_store = (
        np.empty(most_queries * width, dtype=q.dtype),
        np.empty(most_queries * width, dtype=q.dtype),
        np.empty(most_queries * width, dtype=q.dtype),
    )
    k_store, v_store, d_k_store = (
        np.empty(most_keys * width, dtype=q.dtype),
        np.empty(most_keys * width, dtype=q.dtype),
        np.empty(most_keys * width, dtype=q.dtype),
    )
    score_store = np.empty(most_queries * most_keys, dtype=q.dtype)
    at = 0
    for m in range(q_first.shape[0] - 1):
        start, first = q_first[m], k_first[m]
        rows, columns = q_first[m + 1] - start, k_first[m + 1] - first
        for h in range(heads):
            shares = weights[at : at + rows * columns].reshape(rows, columns)
            at += rows * columns
            own = _gather(q, q_rows, start, start + rows, h, q_store)
            pulled = _gather(grad, q_rows, start, start + rows, h, grad_store)
            other = _gather(k, k_rows, first, first + columns, k_head + h, k_store)
            seen = _gather(v, k_rows, first, first + columns, v_head + h, v_store)
            scores = score_store[: rows * columns].reshape(rows, columns)
            np.dot(pulled, seen.T, scores)
            for i in range(rows):
                mean = _dot(shares[i], scores[i])
                for j in range(columns):
                    scores[i, j] = shares[i, j] * (scores[i, j] - mean) * scale
            d_own = d_q_store[: rows * width].reshape(rows, width)
            np.dot(scores, other, d_own)
            _scatter(d_own, q_rows, start, h, d_q)
            d_other = d_k_store[: columns * width].reshape(columns, width)
            np.dot(scores.T, own, d_other)
            _scatter(d_other, k_rows, first, k_head + h, d_k)
            np.dot(shares.T, pulled, d_other)
            _scatter(d_other, k_rows, first, v_head + h, d_v)
