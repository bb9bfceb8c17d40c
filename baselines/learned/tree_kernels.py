"""A forest's answer, compiled: plain arrays in, plain arrays out."""

from __future__ import annotations

from numba import int64, void

from fdi_gym.kernels import M, V, compiled

I1 = int64[::1]


@compiled(void(M, I1, V, I1, I1, M, I1, I1, M))
def descend(x, feature, threshold, left, right, value, roots, target, out):
    """out[i] += the value of the leaf that row x[i] comes to, of every tree.

    At node j a row goes left where x[feature[j]] <= threshold[j]; a leaf has feature -1. A tree whose target is -1 adds a
    value for each label, any other one for its target alone.
    """
    for i in range(len(x)):
        for t in range(len(roots)):
            j = roots[t]
            while feature[j] >= 0:
                j = left[j] if x[i, feature[j]] <= threshold[j] else right[j]
            if target[t] >= 0:
                out[i, target[t]] += value[j, 0]
            else:
                for c in range(out.shape[1]):
                    out[i, c] += value[j, c]
