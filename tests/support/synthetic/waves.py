"""A height field that is a sum of plane waves: exact value and slope everywhere, no grid behind it."""

from dataclasses import dataclass, replace

import numpy as np

_CHUNK = 8192       # points at a time: the temporaries stay in the processor's cache
_TOGETHER = 16384   # values of waves and points at a time, where points are few


@dataclass(frozen=True, eq=False)
class Waves:
    """sum_k amplitude_k sin(2 pi (frequency_k . (x, y) + phase_k)), times 1 + a slow envelope."""

    amplitude: np.ndarray   # (n,), scene units
    frequencies: np.ndarray # (n, 2), waves per scene unit along x and y: direction / wavelength
    phase: np.ndarray       # (n,), cycles, 0 to 1
    envelope: "Waves | None" = None       # makes detail strong in some places and weak in others

    @classmethod
    def random(cls, rng, number, shortest, longest, power, *, envelope=None) -> "Waves":
        """`number` waves in random directions, wavelengths spread evenly in log, amplitude ~ wavelength**power."""
        edges = np.linspace(np.log(shortest), np.log(longest), number + 1)
        length = np.exp(edges[:-1] + rng.uniform(0.0, 1.0, number) * np.diff(edges))
        angle = rng.uniform(0.0, 2.0 * np.pi, number)
        frequencies = np.stack([np.cos(angle), np.sin(angle)], axis=-1) / length[:, None]
        amplitude = (length / longest) ** power
        amplitude /= np.sqrt(0.5 * (amplitude**2).sum())
        return cls(amplitude, frequencies, rng.uniform(0.0, 1.0, number), envelope)

    def scaled(self, factor: float) -> "Waves":
        """The same field times `factor` (a field of `random` has root mean square 1 before its envelope)."""
        return replace(self, amplitude=self.amplitude * factor)

    def __call__(self, x, y, *, precise=True) -> np.ndarray:
        """Height and both slopes at points x, y of one shape: float64 of shape (3, *x.shape). `precise` takes float64
        sines (error 1e-13 of the amplitude); else float32 sines of exactly reduced phases (3e-7 of it), forty times
        faster."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        out = np.empty((3, x.size))
        flat_x, flat_y = x.ravel(), y.ravel()
        for start in range(0, x.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            out[:, part] = self._chunk(flat_x[part], flat_y[part], precise)
        return out.reshape(3, *x.shape)

    def _chunk(self, x, y, precise):
        total, together = np.zeros((3, x.size)), max(1, _TOGETHER // max(x.size, 1))
        for start in range(0, len(self.amplitude), together):
            waves = slice(start, start + together)
            tx, ty = self.frequencies[waves].T[:, :, None]
            amplitude, phase = self.amplitude[waves, None], self.phase[waves, None]
            turn = tx * x + (ty * y + phase)
            turn -= np.rint(turn)
            angle = (2.0 * np.pi) * turn if precise else ((2.0 * np.pi) * turn).astype(np.float32)
            rise = (2.0 * np.pi * amplitude) * np.cos(angle)
            for sum_, terms in zip(total, (amplitude * np.sin(angle), tx * rise, ty * rise)):
                for term in terms:       # one by one: the same digits whatever number of waves is taken together
                    sum_ += term
        if self.envelope is not None:
            gain, gain_x, gain_y = self.envelope._chunk(x, y, precise)
            gain += 1.0
            total[1] = total[1] * gain + total[0] * gain_x
            total[2] = total[2] * gain + total[0] * gain_y
            total[0] *= gain
        return total
