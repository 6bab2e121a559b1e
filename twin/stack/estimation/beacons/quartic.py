"""Real roots of the quartic, and distances to three nodes from it (Liu et al. 2022, Eqs. 9-13)."""

import numpy as np
from numba import njit


@njit(cache=True)
def real_roots(c4, c3, c2, c1, c0, out):
    """Real roots of c4 x^4 + ... + c0 into out (4,), near-double ones included; returns how many.

    Two quadratics by the resolvent cubic's largest root. A pair of complex roots with a small
    imaginary part is given as its real part twice: noise and rounding part double roots that way,
    and the caller polishes and checks what it gets.
    """
    b, c, d, e = c3 / c4, c2 / c4, c1 / c4, c0 / c4
    shift = 0.25 * b
    # Depressed: z^4 + p z^2 + q z + r, x = z - b/4.
    p = c - 6.0 * shift * shift
    q = d - 2.0 * shift * c + 8.0 * shift**3
    r = e - shift * d + shift * shift * c - 3.0 * shift**4
    # z^4 + p z^2 + q z + r = (z^2 + g z + h)(z^2 - g z + k); m = g^2 solves the cubic
    # m^3 + 2 p m^2 + (p^2 - 4 r) m - q^2 = 0, which has a root m >= 0: take the largest.
    m = _largest(2.0 * p, p * p - 4.0 * r, -q * q)
    scale = abs(p) + abs(q) ** (2.0 / 3.0) + np.sqrt(abs(r)) + 1e-300
    n = np.int64(0)
    if m > 1e-14 * scale:
        g = np.sqrt(m)
        h = 0.5 * (p + m - q / g)
        k = 0.5 * (p + m + q / g)
        n = _quadratic(g, h, -shift, scale, out, n)
        n = _quadratic(-g, k, -shift, scale, out, n)
    else:  # biquadratic
        disc = 0.25 * p * p - r
        root = np.sqrt(max(disc, 0.0))
        n = _quadratic(0.0 * p, 0.5 * p - root, -shift, scale, out, n)
        n = _quadratic(0.0 * p, 0.5 * p + root, -shift, scale, out, n)
    return n


@njit(cache=True)
def _largest(a2, a1, a0):
    """Largest real root of m^3 + a2 m^2 + a1 m + a0."""
    shift = a2 / 3.0
    p = a1 - a2 * shift
    q = a0 - shift * a1 + 2.0 * shift**3
    disc = 0.25 * q * q + p**3 / 27.0
    if disc >= 0.0:
        root = np.sqrt(disc)
        u = np.cbrt(-0.5 * q - root) if q > 0.0 else np.cbrt(-0.5 * q + root)
        m = u - (p / (3.0 * u) if u != 0.0 else 0.0)
    else:
        size = np.sqrt(-p / 3.0)
        cosine = min(1.0, max(-1.0, -0.5 * q / size**3))
        m = 2.0 * size * np.cos(np.arccos(cosine) / 3.0)
    m -= shift
    for _ in range(2):
        slope = (3.0 * m + 2.0 * a2) * m + a1
        if slope != 0.0:
            step = (((m + a2) * m + a1) * m + a0) / slope
            if abs(step) < 0.1 * abs(m) + 1e-300:
                m -= step
    return m


@njit(cache=True)
def _quadratic(b, c, shift, scale, out, n):
    half = -0.5 * b
    disc = half * half - c
    if disc < -1e-3 * (half * half + scale):
        return n
    root = np.sqrt(max(disc, 0.0))
    far = half + root if half >= 0.0 else half - root
    out[n] = far + shift
    out[n + 1] = (c / far if far != 0.0 and disc > 0.0 else half) + shift
    return n + 2


@njit(cache=True)
def distances(c12, c13, c23, s12, s13, s23, slack, out, roots):
    """All positive distances that obey the cosine rule (Eq. 9); returns how many, at most four.

    With x = d1/d3, y = d2/d3, v = s23/s12, w = s13/s12 (Eq. 11; the print's v and w are garbled)
    elimination of u leaves, for Q = (1 - w) x^2 - 2 c13 x + 1:

        -w y^2 + 2 w c12 x y + Q = 0
        (1 - v) y^2 + 2 (v c12 x - c23) y + 1 - v x^2 = 0

    and (1 - v) times the first plus w times the second gives y = b0 / b1, b1 = 2 w (c12 x - c23),
    b0 = (v + w - 1) x^2 + 2 (1 - v) c13 x + v - w - 1 (Eq. 13). Put back into the first:
    b0^2 - 4 w c12 x b0 l - 4 w Q l^2 = 0 with l = c12 x - c23.

    Args:
        c12, c13, c23: cosines between the rays.
        s12, s13, s23: squared distances between the nodes, m^2.
        slack: error of Eq. 9 over the squared sides that still is a solution. Noise near the danger
            cylinder can leave two real solutions none: with some slack their middle is given.
        out: distances and conditioning of each solution. Shape (4, 4): d1, d2, d3, and the
            determinant of the three equations by the distances, rows of length one; 0 on the
            danger cylinder.
        roots: scratch. Shape (4,).
    """
    n = np.int64(0)
    for order in range(3):  # the nodes change places where a leading coefficient fails
        if order == 0:
            n, good = _solve(c12, c13, c23, s12, s13, s23, order, slack, out, roots, n)
        elif order == 1:  # 2, 3, 1
            n, good = _solve(c23, c12, c13, s23, s12, s13, order, slack, out, roots, n)
        else:  # 3, 1, 2
            n, good = _solve(c13, c23, c12, s13, s23, s12, order, slack, out, roots, n)
        if good:
            break
    return n


@njit(cache=True)
def _solve(c12, c13, c23, s12, s13, s23, order, slack, out, roots, n):
    """Solutions for one order of the nodes, added to out unless there already.

    Second value: whether no other order needs to be tried.
    """
    v, w = s23 / s12, s13 / s12
    a2, a1, a0 = v + w - 1.0, 2.0 * (1.0 - v) * c13, v - w - 1.0
    q2, q1 = 1.0 - w, -2.0 * c13
    l1, l0 = c12, -c23
    f = 4.0 * w
    # l^2, and b0 times l
    m2, m1, m0 = l1 * l1, 2.0 * l1 * l0, l0 * l0
    p3, p2, p1, p0 = a2 * l1, a2 * l0 + a1 * l1, a1 * l0 + a0 * l1, a0 * l0
    k4 = a2 * a2 - f * (c12 * p3 + q2 * m2)
    k3 = 2.0 * a2 * a1 - f * (c12 * p2 + q2 * m1 + q1 * m2)
    k2 = a1 * a1 + 2.0 * a2 * a0 - f * (c12 * p1 + q2 * m0 + q1 * m1 + m2)
    k1 = 2.0 * a1 * a0 - f * (c12 * p0 + q1 * m0 + m1)
    k0 = a0 * a0 - f * m0
    largest = max(abs(k4), abs(k3), abs(k2), abs(k1), abs(k0))
    if not abs(k4) > 1e-7 * largest:
        return n, False
    good = True
    count = real_roots(k4, k3, k2, k1, k0, roots)
    for i in range(count):
        x = roots[i]
        if not x > 0.0:
            continue
        value = (((k4 * x + k3) * x + k2) * x + k1) * x + k0
        slope = ((4.0 * k4 * x + 3.0 * k3) * x + 2.0 * k2) * x + k1
        if slope != 0.0 and abs(value) < 0.05 * abs(slope * x):
            x -= value / slope
        base = x * x - 2.0 * c13 * x + 1.0
        if not base > 1e-14:
            good = False
            continue
        d3 = np.sqrt(s13 / base)
        line = l1 * x + l0
        if abs(line) > 1e-4:
            y = ((a2 * x + a1) * x + a0) / (2.0 * w * line)
            before = n
            n = _add(x * d3, y * d3, d3, c12, c13, c23, s12, s13, s23, order, slack, out, n)
            # Two near roots that polishing took to one: another order parts them differently.
            good = good and (n > before or y <= 0.0)
        else:  # both y of the first equation; what is false fails the check
            good = False
            root = np.sqrt(max(c12 * c12 * x * x + (q2 * x * x + q1 * x + 1.0) / w, 0.0))
            for y in (c12 * x + root, c12 * x - root):
                n = _add(x * d3, y * d3, d3, c12, c13, c23, s12, s13, s23, order, slack, out, n)
    return n, good


@njit(cache=True)
def _add(d1, d2, d3, c12, c13, c23, s12, s13, s23, order, slack, out, n):
    """Polishes a solution by Newton's method on Eq. 9, checks it, and adds it to out."""
    if n == 4 or not (d1 > 0.0 and d2 > 0.0 and d3 > 0.0):
        return n
    size = s12 + s13 + s23
    conditioning, before = 0.0, np.inf
    least, b1, b2, b3 = np.inf, d1, d2, d3
    for _ in range(12):
        r1 = d1 * d1 + d2 * d2 - 2.0 * d1 * d2 * c12 - s12
        r2 = d1 * d1 + d3 * d3 - 2.0 * d1 * d3 * c13 - s13
        r3 = d2 * d2 + d3 * d3 - 2.0 * d2 * d3 * c23 - s23
        j11, j12 = d1 - d2 * c12, d2 - d1 * c12
        j21, j23 = d1 - d3 * c13, d3 - d1 * c13
        j32, j33 = d2 - d3 * c23, d3 - d2 * c23
        det = -j11 * j23 * j32 - j12 * j21 * j33
        rows = (j11 * j11 + j12 * j12) * (j21 * j21 + j23 * j23) * (j32 * j32 + j33 * j33)
        conditioning = abs(det) / np.sqrt(rows + 1e-300)
        off = abs(r1) + abs(r2) + abs(r3)
        if det == 0.0 or off < 1e-15 * size:
            break
        if off < least:
            least, b1, b2, b3 = off, d1, d2, d3
        if off > 0.5 * before and off < 1e-13 * size:
            break
        before = off
        r1, r2, r3 = 0.5 * r1, 0.5 * r2, 0.5 * r3
        # Cramer's rule
        e1 = (-r1 * j23 * j32 - j12 * (r2 * j33 - j23 * r3)) / det
        e2 = (j11 * (r2 * j33 - j23 * r3) - r1 * j21 * j33) / det
        e3 = (-j11 * r2 * j32 - j12 * j21 * r3 + r1 * j21 * j32) / det
        d1, d2, d3 = d1 - e1, d2 - e2, d3 - e3
        if max(abs(e1), abs(e2), abs(e3)) < 1e-9 * (d1 + d2 + d3):
            off = 0.0
            break
    if not off < 1e-9 * size:
        off, d1, d2, d3 = least, b1, b2, b3
    if not (d1 > 0.0 and d2 > 0.0 and d3 > 0.0 and off < max(slack, 1e-9) * size):
        return n
    if order == 1:  # solved as nodes 2, 3, 1
        d1, d2, d3 = d3, d1, d2
    elif order == 2:  # solved as nodes 3, 1, 2
        d1, d2, d3 = d2, d3, d1
    for i in range(n):
        near = abs(out[i, 0] - d1) + abs(out[i, 1] - d2) + abs(out[i, 2] - d3)
        if near < 1e-6 * (d1 + d2 + d3) * min(1.0, 1e-3 / max(conditioning, 1e-6)):
            return n
    out[n, 0], out[n, 1], out[n, 2], out[n, 3] = d1, d2, d3, conditioning
    return n + 1
