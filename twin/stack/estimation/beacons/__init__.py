"""Pose from rotating laser planes and a network of photodiodes (Liu et al. 2022), in the stack.

The printed source has slips. What is built here was derived anew and differs in:

- Eq. 3: takes the speed of the revolution before; the plant's batches hold one revolution, so
  `Locator.source_fix` takes that one's own. With both, its scatter is the same within its noise.
- Eq. 6: the cross product points away from the node where both tilts are positive; the sign is
  chosen so that the ray lies before the fan (`angles.rays`).
- Eq. 7: treats y as vertical and takes an arcsine of a ratio of legs. Here z is up:
  azimuth = atan2(b, a), elevation = atan2(c, hypot(a, b)).
- Eq. 11: u = T1T2^2 / OT3^2, v = T2T3^2 / T1T2^2, w = T1T3^2 / T1T2^2, and the right sides are
  u, w u, v u. In Eq. 12 the second line has x and y of its squares exchanged (`quartic`).
- Eq. 21: V U^T may be a reflection: three points are flat, so the third singular vectors have no
  sign of their own; here they complete right-handed triads (`rigid`).
- Eq. 25: the image plane Y = 1 does not see a node on the X axis. Here the plane stands at right
  angles to the measured ray (`p3p`).
- Eq. 30: writes R for head to world where Eq. 17 has world to head (`calibration`). Its residual
  grows with range; here it is the angle of the crossing.

Added, not in the source: pulses of the synchronising light tell their number by their spacing
(`stamps.SyncSequence`), because clocks with unknown offsets could not match them otherwise.
"""
