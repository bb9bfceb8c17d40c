"""The two-stage filter's equations, compiled: one episode after the other, in the letters of the paper.

Equation numbers: A. Guven, C. Hajiyev, WSEAS Transactions on Signal Processing 19, 2023, as repaired in the data sheet.
"""

import numpy as np
from numba import boolean, float64, int64, void

from fdi_gym.estimation.compiled import eliminate
from fdi_gym.estimation.sweep_kernels import AGE
from fdi_gym.integration import LANES
from fdi_gym.kernels import M, compiled, floats, helper, inlined

M3, B2, I1 = float64[:, :, ::1], boolean[:, ::1], int64[::1]
DIRECTIONAL, EXPONENTIAL = 1, 2

# For matrices of this size a call of BLAS, or a new array for each result, costs several times what the loops do.


@helper
def product(A, B, C):
    """C = A B."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            C[i, j] = 0.0
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                C[i, j] += A[i, k] * B[k, j]


@helper
def product_with_transposed(A, B, C):
    """C = A B'."""
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[j, k]
            C[i, j] = total


@helper
def product_of_transposed(A, B, C):
    """C = A' B."""
    for i in range(A.shape[1]):
        for j in range(B.shape[1]):
            C[i, j] = 0.0
        for k in range(A.shape[0]):
            for j in range(B.shape[1]):
                C[i, j] += A[k, i] * B[k, j]


@helper
def inner(a, b):
    """a' b."""
    total = 0.0
    for k in range(a.size):
        total += a[k] * b[k]
    return total


@helper
def sensitivity(E_0, E_u, u, E):
    """E of the fault parameter under the command u."""
    for a in range(E.shape[0]):
        for b in range(E.shape[1]):
            E[a, b] = E_0[a, b]
            for j in range(u.size):
                E[a, b] += u[j] * E_u[j, a, b]


@helper
def symmetrise(P):
    """P becomes (P + P') / 2: what rounding took away."""
    for i in range(P.shape[0]):
        for j in range(i + 1):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@inlined
def forget_one(Pz, rule, factor, a_min, a_max, q, aged):
    """Pz (p, p) under forgetting, eigenvalue by eigenvalue (`two_stage_kf.forget`), and q more on its diagonal."""
    p, squares = Pz.shape[0], 0.0
    limit = a_max if rule == DIRECTIONAL else factor * a_max if rule == EXPONENTIAL else np.inf
    for i in range(p):
        for j in range(p):
            squares += Pz[i, j] * Pz[i, j]
            if rule == DIRECTIONAL:
                aged[i, j] = (a_min if i == j else 0.0) + Pz[i, j] * ((a_max - a_min) / a_max)
            elif rule == EXPONENTIAL:
                aged[i, j] = Pz[i, j] / factor
            else:
                aged[i, j] = Pz[i, j]
    if squares > limit * limit:
        P = Pz.copy()
        symmetrise(P)
        a, v = np.linalg.eigh(P)
        for k in range(p):
            if rule == EXPONENTIAL:
                a[k] = max(a[k], min(a[k] / factor, a_max))
            elif a[k] <= a_max:
                a[k] = a_min + a[k] * (a_max - a_min) / a_max
        for i in range(p):
            for j in range(p):
                aged[i, j] = 0.0
                for k in range(p):
                    aged[i, j] += v[i, k] * a[k] * v[j, k]
    for i in range(p):
        for j in range(p):
            aged[i, j] += q if i == j else 0.0


@compiled(void(M3, int64, float64, float64, float64, float64, M3), heap=True)
def forget(Pz, rule, factor, a_min, a_max, q, aged):
    """`forget_one` for Pz (n, p, p)."""
    for e in range(len(Pz)):
        forget_one(Pz[e], rule, factor, a_min, a_max, q, aged[e])


@compiled(AGE, heap=True)
def forget_lanes(constants, n_x, P):
    """`forget_one` for the last entries of covariances P (N N) in lanes; constants: rule, factor, a_min, a_max and q."""
    N = round(np.sqrt(P.shape[0]))
    p = N - n_x
    before, aged = floats((p, p)), floats((p, p))
    rule, factor, a_min, a_max, q = int(constants[0]), constants[1], constants[2], constants[3], constants[4]
    for lane in range(LANES):
        for i in range(p):
            for j in range(p):
                before[i, j] = P[(n_x + i) * N + n_x + j, lane]
        forget_one(before, rule, factor, a_min, a_max, q, aged)
        for i in range(p):
            for j in range(p):
                P[(n_x + i) * N + n_x + j, lane] += aged[i, j] - before[i, j]


@compiled(void(M, M3, M, M3, M3, M3, boolean, M, M, M, M, M3, M3, M, M3, M3))
def predict(x, Px, z, Pz, V, Pz_minus, steady, u, A, B, E_0, E_u, Q, x1, Px1, V1):
    """Over the interval under the command u, eqs. 24 to 31. `steady`: Pz_minus is Pz."""
    n, n_x, p = V.shape
    E, W, WPz, D, a, b = (
        floats((n_x, p)), floats((n_x, p)), floats((n_x, p)), floats((n_x, p)), floats((p, p)), floats((p, n_x))
    )  # fmt: skip
    APx, P = floats((n_x, n_x)), floats((n_x, n_x))
    for k in range(n):
        sensitivity(E_0, E_u, u[k], E)
        product(A, V[k], W)
        for i in range(n_x):
            for j in range(p):
                W[i, j] += E[i, j]
        product(W, Pz[k], WPz)
        if not steady:  # V Pz- = W Pz
            for i in range(p):
                for j in range(p):
                    a[i, j] = Pz_minus[k, i, j]
                for j in range(n_x):
                    b[i, j] = WPz[j, i]
            eliminate(a, b)
        for i in range(n_x):
            for j in range(p):
                V1[k, i, j] = W[i, j] if steady else b[j, i]
                D[i, j] = W[i, j] - V1[k, i, j]
            x1[k, i] = inner(A[i], x[k]) + inner(B[i], u[k]) + inner(D[i], z[k])
        # W Pz W' - V Pz- V', with V Pz- = W Pz
        product(A, Px[k], APx)
        product_with_transposed(APx, A, Px1[k])
        product_with_transposed(WPz, D, P)
        for i in range(n_x):
            for j in range(n_x):
                Px1[k, i, j] = Px1[k, i, j] + Q[k % len(Q), i, j] + P[i, j]
        symmetrise(Px1[k])


@helper
def corrected(x, P, K, r, HP, x1, P1):
    """x + K' r and P - K' HP."""
    product_of_transposed(K, HP, P1)
    for i in range(x.size):
        gained = 0.0
        for a in range(r.size):
            gained += K[a, i] * r[a]
        x1[i] = x[i] + gained
        for j in range(x.size):
            P1[i, j] = P[i, j] - P1[i, j]
    symmetrise(P1)


@compiled(void(M, M3, M, M3, M3, M, B2, M, M, M, M3, M, M3, M3, M, M3, I1))
def correct(x, Px, z, Pz, V, y, seen, C, R, x1, Px1, z1, Pz1, V1, nu, S_z, count):
    """With the measurement y of the sensors that reported, eqs. 32 to 41.

    A sensor that did not report has residual 0, variance 1 and no covariance with anything: its row is gone.
    """
    (n, n_x, p), m = V.shape, y.shape[1]
    r, H, CPx, HPz, S = floats(m), floats((m, p)), floats((m, n_x)), floats((m, p)), floats((m, m))
    a, Kx, Kz = floats((m, m)), floats((m, n_x)), floats((m, p))  # gains, transposed
    for k in range(n):
        product(C, V[k], H)
        product(C, Px[k], CPx)
        product_with_transposed(CPx, C, S)
        count[k] = 0
        for i in range(m):
            r[i] = y[k, i] - inner(C[i], x[k])
            count[k] += seen[k, i]
            for j in range(m):
                S[i, j] += R[i, j]
        for i in range(m):
            if not seen[k, i]:
                r[i] = 0.0
                for j in range(p):
                    H[i, j] = 0.0
                for j in range(n_x):
                    CPx[i, j] = 0.0
                for j in range(m):
                    S[i, j] = S[j, i] = 0.0
                S[i, i] = 1.0
        product(H, Pz[k], HPz)
        product_with_transposed(HPz, H, S_z[k])
        for i in range(m):
            nu[k, i] = r[i] - inner(H[i], z[k])
            for j in range(m):
                S_z[k, i, j] += S[i, j]
                a[i, j] = S_z[k, i, j]
            for j in range(p):
                Kz[i, j] = HPz[i, j]
            for j in range(n_x):
                Kx[i, j] = CPx[i, j]
        eliminate(S, Kx)
        eliminate(a, Kz)
        corrected(x[k], Px[k], Kx, r, CPx, x1[k], Px1[k])
        corrected(z[k], Pz[k], Kz, nu[k], HPz, z1[k], Pz1[k])
        product_of_transposed(Kx, H, V1[k])
        for i in range(n_x):
            for j in range(p):
                V1[k, i, j] = V[k, i, j] - V1[k, i, j]


@compiled(void(M, M3, M, M3, M3, M, M3))
def optimal(x, Px, z, Pz, V, X, P):
    """The optimal state estimate x + V z and its covariance Px + V Pz V', eqs. 40 and 41."""
    n, n_x, p = V.shape
    VPz = floats((n_x, p))
    for k in range(n):
        product(V[k], Pz[k], VPz)
        product_with_transposed(VPz, V[k], P[k])
        for i in range(n_x):
            X[k, i] = x[k, i] + inner(V[k, i], z[k])
            for j in range(n_x):
                P[k, i, j] += Px[k, i, j]
