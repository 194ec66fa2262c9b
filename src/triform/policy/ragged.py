"""Attention on rows of different lengths, without padding: kernels for the CPU, forwards and backwards.

A row is a list of queries that attend to a list of keys; every list holds indices into packed tokens. Occupancy maps
have 11 tokens on average and 30 at most, so that padding a mini-batch to its longest row would triple the work, and
products of such small matrices cost more to launch than to compute.

Queries, keys and values are arrays of shape (tokens, heads, width); ``*_head`` is the place of the first head that is
meant, so that one array may hold all three. Heads and columns stay separate axes because an index that might be
negative keeps the compiler from using vector instructions.
"""

from __future__ import annotations

import numpy as np

from triform.kernels import kernel

# Sums may be taken in vectors only where nothing is written: loops that write are compiled twice, with vectors and, for
# arrays that might overlap, without, and which one runs depends on where memory lies. Both must round alike.
_SUMS = {"reassoc", "contract", "nsz"}


@kernel(fastmath=_SUMS)
def _sum(a, n):
    total = np.float32(0.0)
    for j in range(n):
        total += a[j]
    return total


@kernel(fastmath=_SUMS)
def _dot(a, at, b, n):
    total = np.float32(0.0)
    for j in range(n):
        total += a[at + j] * b[j]
    return total


@kernel(fastmath=_SUMS)
def _dots(a, row, head, b, rows, first, last, b_head, out):
    """``out[j] = a[row] . b[rows[first + j]]``, four at a time; writes up to three values too many."""
    for j in range(first, last, 4):
        r_0, r_1 = rows[j], rows[min(j + 1, last - 1)]
        r_2, r_3 = rows[min(j + 2, last - 1)], rows[min(j + 3, last - 1)]
        s_0 = s_1 = s_2 = s_3 = np.float32(0.0)
        for d in range(a.shape[2]):
            x = a[row, head, d]
            s_0 += x * b[r_0, b_head, d]
            s_1 += x * b[r_1, b_head, d]
            s_2 += x * b[r_2, b_head, d]
            s_3 += x * b[r_3, b_head, d]
        out[j - first] = s_0
        out[j - first + 1] = s_1
        out[j - first + 2] = s_2
        out[j - first + 3] = s_3


@kernel(fastmath={"contract"})
def _add(weights, b, rows, first, last, b_head, out, row, head):
    """``out[row] += sum_j weights[j] b[rows[first + j]]``, four at a time; the weights end in three zeros."""
    for j in range(first, last, 4):
        r_0, r_1 = rows[j], rows[min(j + 1, last - 1)]
        r_2, r_3 = rows[min(j + 2, last - 1)], rows[min(j + 3, last - 1)]
        w_0, w_1, w_2, w_3 = weights[j - first], weights[j - first + 1], weights[j - first + 2], weights[j - first + 3]
        for d in range(b.shape[2]):
            # One after the other, so that there is one way only to fuse products and sums.
            x = out[row, head, d]
            x += w_0 * b[r_0, b_head, d]
            x += w_1 * b[r_1, b_head, d]
            x += w_2 * b[r_2, b_head, d]
            x += w_3 * b[r_3, b_head, d]
            out[row, head, d] = x


@kernel
def _longest(first):
    longest = 0
    for m in range(first.shape[0] - 1):
        longest = max(longest, first[m + 1] - first[m])
    return longest


@kernel
def attend(q, k, v, q_rows, q_first, k_rows, k_first, heads, k_head, v_head, scale, out, weights):
    """Add ``softmax(scale q k^T) v`` to ``out`` (tokens, heads, width) and keep the softmax in ``weights``, flat."""
    s = np.zeros(_longest(k_first) + 3, dtype=q.dtype)
    at = 0
    for m in range(q_first.shape[0] - 1):
        first, last = k_first[m], k_first[m + 1]
        n = last - first
        for h in range(heads):
            for i in range(q_first[m], q_first[m + 1]):
                _dots(q, q_rows[i], h, k, k_rows, first, last, k_head + h, s)
                top = s[0]
                for j in range(1, n):
                    top = max(top, s[j])
                for j in range(n):
                    s[j] = np.exp((s[j] - top) * scale)
                share = np.float32(1.0) / _sum(s, n)
                for j in range(n):
                    s[j] *= share
                    weights[at + j] = s[j]
                s[n : n + 3] = 0.0
                at += n
                _add(s, v, k_rows, first, last, v_head + h, out, q_rows[i], h)


@kernel
def attend_backward(
    q, k, v, q_rows, q_first, k_rows, k_first, heads, k_head, v_head, scale, weights, grad, d_q, d_k, d_v
):
    """Add the gradients of ``attend`` to ``d_q``, ``d_k`` and ``d_v``, laid out like ``q``, ``k`` and ``v``."""
    longest, queries = _longest(k_first), _longest(q_first)
    s = np.zeros(longest + 3, dtype=q.dtype)
    s_by_key = np.zeros((longest, queries + 3), dtype=q.dtype)
    p_by_key = np.zeros((longest, queries + 3), dtype=q.dtype)
    at = 0
    for m in range(q_first.shape[0] - 1):
        first, last = k_first[m], k_first[m + 1]
        n, start, end = last - first, q_first[m], q_first[m + 1]
        for h in range(heads):
            for i in range(start, end):
                _dots(grad, q_rows[i], h, v, k_rows, first, last, v_head + h, s)
                mean = _dot(weights, at, s, n)
                for j in range(n):
                    s[j] = weights[at + j] * (s[j] - mean) * scale
                    s_by_key[j, i - start] = s[j]
                    p_by_key[j, i - start] = weights[at + j]
                s[n : n + 3] = 0.0
                at += n
                _add(s, k, k_rows, first, last, k_head + h, d_q, q_rows[i], h)
            for j in range(n):
                s_by_key[j, end - start : end - start + 3] = 0.0
                p_by_key[j, end - start : end - start + 3] = 0.0
                _add(s_by_key[j], q, q_rows, start, end, h, d_k, k_rows[first + j], k_head + h)
                _add(p_by_key[j], grad, q_rows, start, end, h, d_v, k_rows[first + j], v_head + h)
