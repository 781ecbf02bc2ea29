"""Twin of splat/step: Adam with the plateau schedule (method section 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from twins.project import NEAR


def late_share(step: int, steps: int, final: float) -> float:
    """Of the rate, at step 0, 1, ... of `steps`: 1 over the first half, then linearly down to `final`."""
    return 1 + max(0.0, 2 * (step + 1) / steps - 1) * (final - 1)


@dataclass
class Adam:
    """First and second moments of the gradient, same shape as the depth, their decay per step,
    and the count of steps."""

    m: np.ndarray
    v: np.ndarray
    beta1: float
    beta2: float
    steps: int = 0

    @classmethod
    def start(cls, shape, beta1: float, beta2: float) -> Adam:
        return cls(np.zeros(shape), np.zeros(shape), beta1, beta2)

    def step(self, depth, gradient, length, rate: float, damping: float) -> np.ndarray:
        """The depth after one step on x = d / length.

        Parameters
        ----------
        depth, gradient : ndarray of shape (H, W)
            d in units and N dL/dd; depth 0 = no surface stays 0.
        length : ndarray of shape (H, W)
            u ("parallax") or the viewing distance ("distance"), units; pixels where it is 0 are fixed.
        rate, damping : float
            Step in `length`, and Adam's epsilon.
        """
        g = gradient * length
        self.steps += 1
        self.m = self.beta1 * self.m + (1 - self.beta1) * g
        self.v = self.beta2 * self.v + (1 - self.beta2) * g * g
        mean = self.m / (1 - self.beta1**self.steps)
        scale = np.sqrt(self.v / (1 - self.beta2**self.steps)) + damping
        move = np.where(self.v > 0, mean / np.where(self.v > 0, scale, 1.0), 0.0)
        stepped = np.maximum(depth - rate * length * move, NEAR)
        return np.where((depth > 0) & (length > 0), stepped, depth)


@dataclass
class Plateau:
    """Rate schedule: a tenth after `patience` steps without a better loss; done when it falls below `floor`.

    Attributes
    ----------
    rate : float
        First rate.
    patience : int
        0 keeps the rate.
    floor : float
        Share of the first rate.
    """

    rate: float
    patience: int
    floor: float
    best: float = np.inf
    waited: int = 0
    falls: int = 0

    def next_rate(self, loss: float) -> float:
        """The rate for the step that follows this loss; 0 when the level is done."""
        if self.patience > 0:
            self.waited = 0 if loss < self.best else self.waited + 1
            self.best = min(self.best, loss)
            if self.waited >= self.patience:
                self.waited, self.falls = 0, self.falls + 1
        share = 10.0**-self.falls
        return 0.0 if share < self.floor * (1 - 1e-9) else self.rate * share  # 1e-2 as 0.1 * 0.1 is not below 1e-2
