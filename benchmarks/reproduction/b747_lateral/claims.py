"""The Boeing 747 paper's claims and printed numbers, as checks of pieces."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.reproduction.b747_lateral.paper import BLIND
from benchmarks.reproduction.claims import Check, Checks, Claim, Found, Measured, exact, mean, ratio

FORGETTING, PLAIN = "states-exponential 0.99", "states-TSKF Qz = 0"
STATES = ("beta", "p", "r", "phi")
UNITS = ("deg", "deg/s", "deg/s", "deg")
GAMMA_A, GAMMA_R, B_A, B_R = range(4)


def column(found: Found, piece: str, window: str, i: int) -> list[float]:
    """One state or entry of each flight."""
    return np.array(found[piece][window], float)[:, i].tolist()


def rudder(piece: str) -> Checks:
    """The stuck rudder's entries, and the aileron's, as means over 250 to 600 s; and the declared label."""

    def checks(found: Found) -> list[Check]:
        def mean_of(i: int) -> Measured:
            return mean(column(found, piece, "mean", i))

        return [
            Check("mean gamma_r", mean_of(GAMMA_R), -1.05, -0.95),
            Check("mean b_r", mean_of(B_R), 1.9, 2.1, unit="deg"),
            Check("mean gamma_a", mean_of(GAMMA_A), -0.1, 0.1),
            Check("mean b_a", mean_of(B_A), -0.1, 0.1, unit="deg"),
            Check("labels right", mean(found[piece]["right"]), 0.95),
        ]

    return checks


def states_well(piece: str, most: float) -> Checks:
    """RMSE while the rudder is stuck against before it, the same flights."""

    def checks(found: Found) -> list[Check]:
        return [
            Check(f"{name} faulty/healthy", ratio(column(found, piece, "faulty", i), column(found, piece, "healthy", i)),
                 most=most, digits=2) for i, name in enumerate(STATES)
        ]  # fmt: skip

    return checks


def blind(found: Found) -> list[Check]:
    """RMSE of the fault-blind filter between 230 and 600 s against before."""
    piece = f"states-{BLIND}"
    return [
        Check(f"{name} faulty/healthy", ratio(column(found, piece, "faulty", i), column(found, piece, "healthy", i)), 1.5,
             digits=2) for i, name in enumerate(STATES)
    ]  # fmt: skip


def excitation(found: Found) -> list[Check]:
    """RMSE of gamma_r under commands that excite and that do not."""

    def gamma(command: str) -> Measured:
        return mean(found[f"command-{command}"]["rmse"][2])

    return [Check(f"gamma_r RMSE, {name}", gamma(name), most=0.1) for name in ("multisine", "doublet", "prbs")] + [
        Check(f"gamma_r RMSE, {name}", gamma(name), 0.5) for name in ("const", "zero")
    ]


def modes(found: Found) -> list[Check]:
    """Distance of our eigenvalues from the printed ones."""
    return [Check("largest distance of an eigenvalue of the printed A", exact(found["printed"]["mode error"]), most=1e-4,
                 digits=6)]  # fmt: skip


def spiral(found: Found) -> list[Check]:
    """A spiral mode is one real root."""
    real = [v for v, imaginary in found["printed"]["modes"] if not imaginary]
    return [Check("real eigenvalues of the printed A", exact(len(real)), 1, digits=0)]


def ranks(found: Found) -> list[Check]:
    """Controllability and observability."""
    return [Check(f"rank, {name}", exact(found["printed"][name]), 4, 4, digits=0) for name in ("controllable", "observable")]


def table_1(found: Found) -> list[Check]:
    """How many entries of A and B the derivative table gives."""
    near, n = found["printed"]["near"]
    return [Check(f"share of the {n} nonzero entries of A and B within 3 %", exact(near / n), 0.95, digits=2)]


def literal_35(found: Found) -> list[Check]:
    """The time at which the printed recursion leaves all bounds."""
    times = [math.inf if t is None else t for t in found["equation 35"]["seconds"]]
    return [Check("share of flights whose estimate stays below 1e6 until the fault begins",
            exact(float(np.mean(np.array(times) > 200))), 0.95,
                 digits=2),
            Check("time at which it passes 1e6", mean(times), 800.0, digits=0, unit="s")]  # fmt: skip


CLAIMS = (
    Claim("(a)", "The stuck rudder (-1, 2 deg from 200 to 600 s) is estimated and isolated; the aileron's entries stay",
          rudder(FORGETTING), "with exponential forgetting 0.99: the paper names a forgetting factor and gives no rule",
          FORGETTING),
    Claim("(a), as printed", "The same by the printed recursion, without forgetting or random walk", rudder(PLAIN),
          "after 200 s of healthy flight its covariance is too small to follow the fault within 400 s", PLAIN),
    Claim("(b)", "The states are estimated well (Figures 3 to 6)", states_well(FORGETTING, 1.1),
          "with forgetting, as well while the rudder is stuck as before it", FORGETTING),
    Claim("(b), as printed", "The same without forgetting", states_well(PLAIN, 1.1), "", PLAIN),
    Claim("(c)", "Without the filter the state estimates are broken from 200 to 600 s", blind,
          "true of a Kalman filter that knows of no fault; the two-stage filter itself is (b)", f"states-{BLIND}"),
    Claim("(d)", "Excitation is required", excitation,
          "a constant command shows gamma_r u + b_r only, a zero command no gamma_r", "command-"),
    Claim("(e)", "Reconfigurable control is the next step", lambda found: [],
          open="an outlook: the paper shows no result, and this page flies no reconfigured control"),
    Claim("ranks", "Controllability and observability have rank 4", ranks,
          "the paper writes the second as rank of obsv(A, B); with C = I it is 4 whatever A is", "printed"),
    Claim("eigenvalues", "-0.2897 +- 1.0765i (Dutch roll), -0.6507 +- 0.4102i", modes, "", "printed"),
    Claim('"spiral"', "The second pair is the spiral mode", spiral,
          "a spiral mode is one real root: the printed A has none, the airframe of Table 1 has two (roll and spiral)",
          "printed"),
    Claim("A, B", "A and B follow from the derivatives of Table 1", table_1,
          "the yaw row of A holds a rudder feedback on all states, and L_dr has lost a factor of ten; see below", "printed"),
    Claim("eq. 35", "The bias is corrected with the gain Kx", literal_35,
          "literally: Kz belongs there, and all dimensions are 4, so that nothing shows it. Everything else here has Kz",
          "equation 35"),
)  # fmt: skip
