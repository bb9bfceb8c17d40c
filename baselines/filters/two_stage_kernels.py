"""The two-stage filter's equations, compiled: one episode after the other, in the letters of the paper.

Equation numbers: A. Guven, C. Hajiyev, WSEAS Transactions on Signal Processing 19, 2023, as repaired in the data sheet.
"""

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.compiled import eliminate, helper
from fdi_gym.kernels import M, compiled

M3, B2, I1 = float64[:, :, ::1], boolean[:, ::1], int64[::1]
DIRECTIONAL, EXPONENTIAL = 1, 2


@helper
def solved(S, N):
    """S^-1 N."""
    a, b = S.copy(), N.copy()
    eliminate(a, b)
    return b


@helper
def product(A, B):
    """A B: for matrices of this size a call of BLAS costs several times what the loops do."""
    (n, m), r = A.shape, B.shape[1]
    C = np.zeros((n, r))
    for i in range(n):
        for k in range(m):
            for j in range(r):
                C[i, j] += A[i, k] * B[k, j]
    return C


@helper
def times(A, v):
    """A v."""
    n, m = A.shape
    w = np.empty(n)
    for i in range(n):
        total = 0.0
        for k in range(m):
            total += A[i, k] * v[k]
        w[i] = total
    return w


@helper
def symmetric(P):
    """(P + P') / 2: what rounding took away."""
    return 0.5 * (P + P.T)


@compiled(void(M3, int64, float64, float64, float64, float64, M3))
def forget(Pz, rule, factor, a_min, a_max, q, aged):
    """Pz (n, p, p) under forgetting, eigenvalue by eigenvalue (`two_stage_kf.forget`), and q more on its diagonal."""
    eye = np.eye(Pz.shape[1])
    for e in range(len(Pz)):
        P, limit = Pz[e], np.inf
        if rule == DIRECTIONAL:
            limit, aged[e] = a_max, a_min * eye + P * ((a_max - a_min) / a_max)
        elif rule == EXPONENTIAL:
            limit, aged[e] = factor * a_max, P / factor
        else:
            aged[e] = P
        if (P * P).sum() > limit * limit:
            a, v = np.linalg.eigh(symmetric(P))
            for i in range(len(a)):
                if rule == EXPONENTIAL:
                    a[i] = max(a[i], min(a[i] / factor, a_max))
                elif a[i] <= a_max:
                    a[i] = a_min + a[i] * (a_max - a_min) / a_max
            aged[e] = product(v * a, v.T)
        aged[e] += q * eye


@compiled(void(M, M3, M, M3, M3, M3, boolean, M, M, M, M, M3, M3, M, M3, M3))
def predict(x, Px, z, Pz, V, Pz_minus, steady, u, A, B, E_0, E_u, Q, x1, Px1, V1):
    """Over the interval under the command u, eqs. 24 to 31. `steady`: Pz_minus is Pz."""
    for k in range(len(x)):
        E = E_0.copy()
        for j in range(len(E_u)):
            E += u[k, j] * E_u[j]
        W = product(A, V[k]) + E
        WPz = product(W, Pz[k])
        if steady:
            V1[k] = W
        else:
            V1[k] = solved(Pz_minus[k], WPz.T).T
        x1[k] = times(A, x[k]) + times(B, u[k]) + times(W - V1[k], z[k])
        # W Pz W' - V Pz- V', with V Pz- = W Pz
        Px1[k] = symmetric(product(product(A, Px[k]), A.T) + Q[k % len(Q)] + product(WPz, (W - V1[k]).T))


@compiled(void(M, M3, M, M3, M3, M, B2, M, M, M, M3, M, M3, M3, M, M3, I1))
def correct(x, Px, z, Pz, V, y, seen, C, R, x1, Px1, z1, Pz1, V1, nu, S_z, count):
    """With the measurement y of the sensors that reported, eqs. 32 to 41.

    A sensor that did not report has residual 0, variance 1 and no covariance with anything: its row is gone.
    """
    for k in range(len(x)):
        r, H, CPx = y[k] - times(C, x[k]), product(C, V[k]), product(C, Px[k])
        S = product(CPx, C.T) + R
        count[k] = 0
        for i in range(len(r)):
            if seen[k, i]:
                count[k] += 1
            else:
                r[i], H[i], CPx[i] = 0.0, 0.0, 0.0
                S[i], S[:, i], S[i, i] = 0.0, 0.0, 1.0
        HPz = product(H, Pz[k])
        S_z[k] = product(HPz, H.T) + S
        Kx, Kz = solved(S, CPx).T, solved(S_z[k], HPz).T
        nu[k] = r - times(H, z[k])
        x1[k], Px1[k] = x[k] + times(Kx, r), symmetric(Px[k] - product(Kx, CPx))
        z1[k], Pz1[k] = z[k] + times(Kz, nu[k]), symmetric(Pz[k] - product(Kz, HPz))
        V1[k] = V[k] - product(Kx, H)


@compiled(void(M, M3, M, M3, M3, M, M3))
def optimal(x, Px, z, Pz, V, X, P):
    """The optimal state estimate x + V z and its covariance Px + V Pz V', eqs. 40 and 41."""
    for k in range(len(x)):
        X[k] = x[k] + times(V[k], z[k])
        P[k] = Px[k] + product(product(V[k], Pz[k]), V[k].T)
