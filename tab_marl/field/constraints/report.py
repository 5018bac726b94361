"""How well the constraints of a fitted field hold."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ConstraintFit:
    """One constraint E_P[f] = target."""

    name: str
    target: float
    """0 for a share of a timing prior or of goal marginals: then f is the visit minus its share of all."""
    present: float
    """E_P[f]."""
    multiplier: float
    """lambda: the log-weight of one more f."""
    allowed: float
    """The stated tolerance of |residual|."""

    @property
    def residual(self) -> float:
        return self.present - self.target


@dataclass(frozen=True)
class FitReport:
    """The convergence of a fit of soft constraints."""

    constraints: tuple[ConstraintFit, ...]
    iterations: int
    """Steps of the ascent."""
    passes: int
    """Evaluations of the dual, one backward and one forward pass each."""
    dual: float
    """lambda' c - sum mu0 log Z: at the optimum KL(P || Q), below it before."""

    @property
    def worst(self) -> float:
        """The largest |residual| / allowed; at most 1."""
        return max((abs(c.residual) / c.allowed for c in self.constraints), default=0.0)

    def __str__(self) -> str:
        width = max((len(c.name) for c in self.constraints), default=0)
        lines = [
            f"{c.name:<{width}}  target {c.target:.4f}  present {c.present:.6f}  residual {c.residual:+.1e} "
            f"(allowed {c.allowed:.0e})  multiplier {c.multiplier:+.4f}"
            for c in self.constraints
        ]
        return "\n".join([*lines, f"{self.iterations} steps, {self.passes} passes, dual {self.dual:.6f} nats"])
