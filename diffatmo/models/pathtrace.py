"""prototype 2"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffatmo import geometry, phase
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Model, Path, Ray, Sky
from diffatmo.numerics import safe_divide, safe_sqrt

PANELS = 12
_LATTICE = np.array(
    [
        1,
        7319,
        12989,
        9145,
        6835,
        3019,
        16245,
        10769,
        13605,
        14093,
        4279,
        753,
        7361,
        12065,
        14255,
        1683,
        223,
        9875,
        9429,
        2697,
        8415,
        15147,
        10321,
        9145,
    ],
    np.uint32,
)
FLOOR = 0.02
ALPHA = 0.5
BETA = 0.75
USEMAX = True


def _mix(x):
    x = x ^ (x >> 16)
    x = x * np.uint32(0x7FEB352D)
    x = x ^ (x >> 15)
    x = x * np.uint32(0x846CA68B)
    return x ^ (x >> 16)


def _unit(bits, dtype):
    return ((bits >> 9).astype(dtype) + 0.5) * (0.5**23)


def _uniform(key, index, dim, log2n, dtype):
    """lattice or hash"""
    shift = _mix(_mix(key[0] ^ (dim * np.uint32(0x9E3779B9))) + key[1])
    z = jnp.asarray(_LATTICE)[jnp.minimum(dim, len(_LATTICE) - 1)]
    lattice = shift + ((index * z) << (32 - log2n))
    other = _mix(shift ^ _mix(index + np.uint32(0x68BC21EB)))
    return _unit(jnp.where(dim < len(_LATTICE), lattice, other), dtype)


def _random(key, index, dim, dtype):
    a = _mix(key[1] ^ (dim * np.uint32(0x85EBCA6B)) ^ np.uint32(0x2C1B3C6D)) + key[0]
    return _unit(_mix(a ^ _mix(index + np.uint32(0x68BC21EB))), dtype)


def _densities(atm, h):
    return (atm.rayleigh_density(h), atm.mie_density(h), atm.ozone_density(h))


class _Segment(NamedTuple):
    h: jax.Array
    mu: jax.Array
    length: jax.Array
    ground: jax.Array
    lo: jax.Array
    x_lo: jax.Array
    start: jax.Array
    split: jax.Array


def _segment(atm, h, mu, ground=None):
    R, top = atm.bottom_radius, atm.top_altitude
    if ground is None:
        ground = jnp.zeros(h.shape, bool)
    length = geometry.distance_to_boundary(h, mu, ground, R, top)
    down = mu < 0
    lo = jnp.where(ground, 0, jnp.where(down, jnp.maximum(geometry.perigee_altitude(h, mu, R), 0), h))
    r_mu = jnp.abs((R + h) * mu)
    x_lo = jnp.where(ground, jnp.maximum(r_mu - length, 0), jnp.where(down, 0, r_mu))
    start = jnp.where(down, jnp.where(ground, length, r_mu), 0)
    split = jnp.where(ground, 1.0, jnp.where(down, 0.5, 0.0)).astype(h.dtype)
    return _Segment(h, mu, length, ground, lo, x_lo, start, split)


def _edge(atm, s, v):
    R, top = atm.bottom_radius, atm.top_altitude
    below = v < s.split
    part = jnp.where(below, (s.split - v) / jnp.maximum(s.split, 0.5), (v - s.split) / jnp.maximum(1 - s.split, 0.5))
    dz = (jnp.where(below, s.h, jnp.where(s.ground, 0, top)) - s.lo) * part * part * part
    gap = jnp.maximum(dz * (dz + 2 * (s.lo + R)), 0)
    x = gap / jnp.maximum(s.x_lo + jnp.sqrt(s.x_lo * s.x_lo + gap), 1e-10)
    return s.start + jnp.where(below, -x, x)


def _walk(atm, s, jitter, end, visit, carry, panels=PANELS):
    """Simpson panels along the segment; visit(carry, t0,t1,h1,cols0,cols1,n1)->carry,y"""
    R = atm.bottom_radius

    def body(state, k):
        t0, n0, cols, inner = state
        t1 = jnp.where(k == panels, end, jnp.clip(_edge(atm, s, (k + jitter) / panels), t0, end))
        dt = t1 - t0
        nm = _densities(atm, geometry.altitude_along(s.h, s.mu, 0.5 * (t0 + t1), R))
        h1 = geometry.altitude_along(s.h, s.mu, t1, R)
        n1 = _densities(atm, h1)
        new = tuple(c + dt / 6 * (a + 4 * b + d) for c, a, b, d in zip(cols, n0, nm, n1))
        inner, y = visit(inner, t0, t1, h1, n1, cols, new)
        return (t1, n1, new, inner), y

    z = jnp.zeros_like(s.h)
    (_, _, cols, carry), ys = jax.lax.scan(body, (z, _densities(atm, s.h), (z, z, z), carry), jnp.arange(panels + 1))
    return cols, carry, ys


def _coef(atm):
    ext = jnp.stack([atm.rayleigh_scattering, atm.mie_extinction, atm.ozone_absorption])  # 3,w
    sca = jnp.stack([atm.rayleigh_scattering, atm.mie_scattering])
    return ext, sca


def _tau(ext, cols):
    """[w, ...]"""
    return jnp.einsum("sw,s...->w...", ext, jnp.stack(cols))


def _sun_transmittance(atm, h, mu_s, jitter, panels=PANELS):
    s = _segment(atm, h, mu_s)
    cols, _, _ = _walk(atm, s, jitter, s.length, lambda c, *_: (c, None), None, panels)
    return jnp.where(geometry.hits_ground(h, mu_s, atm.bottom_radius), 0, jnp.exp(-_tau(_coef(atm)[0], cols)))


# ---- guide ----
NH, NS = 24, 128
NQ, NAZ = 6, 8
B, YLO = 0.3, -0.8


def _cell(h, mu_s, top):
    iv = (jnp.sqrt(jnp.clip(h / top, 0, 1)) * (NH - 1) + 0.5).astype(jnp.int32)
    m = jnp.abs(mu_s)
    y = 0.5 * (jnp.sqrt(B * B + 4 * (1 + B) * m) - B)
    y = jnp.where(mu_s < 0, -y, y)
    js = (jnp.clip((y - YLO) / (1 - YLO), 0, 1) * (NS - 1) + 0.5).astype(jnp.int32)
    return iv * NS + js


def _grid(top, dtype):
    v = jnp.arange(NH, dtype=dtype) / (NH - 1)
    h = v * v * top
    y = YLO + (1 - YLO) * jnp.arange(NS, dtype=dtype) / (NS - 1)
    return h, y * (jnp.abs(y) + B) / (1 + B)


class _Guide(NamedTuple):
    sun: jax.Array  # [w*NH*NS]
    diffuse: jax.Array
    ground: jax.Array  # [w*NS]
    cdf: jax.Array  # [NH*NS*bins]


def _mu_edges(hor):
    q = np.arange(NQ + 1) / NQ
    lower = [-1 + (hor + 1) * x for x in q[:-1]]
    upper = [hor + (1 - hor) * x * x for x in q]
    return lower + upper


def _build_guide(atm, iters=10):
    dtype = atm.bottom_radius.dtype
    top, R = atm.top_altitude, atm.bottom_radius
    h, m = _grid(top, dtype)
    ext, sca = _coef(atm)
    w = ext.shape[1]
    H, S = jnp.meshgrid(h, m, indexing="ij")
    tsun = _sun_transmittance(atm, H, S, 0.5)  # w,NH,NS
    edges = jnp.stack(_mu_edges(geometry.horizon_mu(h, R)), axis=-1)  # NH, nd+1
    wmu = edges[:, 1:] - edges[:, :-1]
    mu = 0.5 * (edges[:, 1:] + edges[:, :-1])
    az = jnp.asarray((np.arange(NAZ) + 0.5) * np.pi / NAZ, dtype)
    hh = jnp.broadcast_to(h[:, None], mu.shape)
    ground = geometry.hits_ground(hh, mu, R)
    s = _segment(atm, hh, mu, ground)
    cols, _, (tm, hm, dsca, tau) = _walk(
        atm,
        s,
        0.5,
        s.length,
        lambda c, t0, t1, h1, n1, c0, c1: (
            c,
            (
                0.5 * (t0 + t1),
                geometry.altitude_along(hh, mu, 0.5 * (t0 + t1), R),
                _tau(sca, (c1[0] - c0[0], c1[1] - c0[1])),
                0.5 * (_tau(ext, c0) + _tau(ext, c1)),
            ),
        ),
        None,
    )
    w_m = jnp.moveaxis(dsca * jnp.exp(-tau), 1, 0)  # w,M,NH,nd
    T = jnp.exp(-_tau(ext, cols))
    sin = geometry.sine(mu)
    nu = mu[..., None, None] * m + (sin[..., None] * jnp.cos(az))[..., None] * jnp.sqrt(1 - m * m)  # NH,nd,az,NS
    ms = jnp.clip(((R + hh)[..., None, None] * m + tm[..., None, None] * nu) / (R + hm)[..., None, None], -1, 1)
    idx = _cell(hm[..., None, None], ms, top)
    gms = jnp.clip(((R + hh)[..., None, None] * m + s.length[..., None, None] * nu) / R, -1, 1)
    gidx = _cell(jnp.zeros_like(gms), gms, top)

    def gather(w_m, T, tsun, J, G):
        src = (tsun / (4 * jnp.pi) + J).ravel()
        i = jnp.sum(w_m[..., None, None] * src[idx], axis=0)
        i = i + jnp.where(ground[..., None, None], T[..., None, None] * G[gidx], 0)
        Jn = jnp.einsum("hd,hdas->hs", wmu, i) / (2 * NAZ)
        return i, Jn

    def body(_, carry):
        def one(a):
            i, Jn = gather(*a[:-1])
            E = 2 * jnp.pi * jnp.einsum("d,das->s", wmu[0] * jnp.maximum(mu[0], 0), i[0]) / NAZ
            return Jn, a[-1] / jnp.pi * (jnp.maximum(m, 0) * a[2][0] + E)

        return jax.lax.map(one, (w_m, T, tsun, *carry, atm.ground_albedo))

    J, G = jax.lax.fori_loop(0, iters, body, (jnp.zeros_like(tsun), jnp.zeros((w, NS), dtype)))

    def dirs(a):
        i, Jn = gather(*a)
        return i / jnp.maximum(Jn[:, None, None], 1e-35)

    bright = jnp.sum(jax.lax.map(dirs, (w_m, T, tsun, J, G)), axis=0)  # NH,nd,az,NS
    p = jnp.moveaxis((bright * wmu[:, :, None, None]).reshape(NH, -1, NS), 1, 2) + 1e-6
    cdf = jnp.cumsum(p, axis=-1)
    cdf = cdf / cdf[..., -1:]

    def dilate(x):
        n = x.shape[2]
        pad = jnp.pad(x, [(0, 0), (0, 0), (1, 1)], mode="edge")
        return jnp.maximum(x, jnp.maximum(pad[:, :, :n], pad[:, :, 2:]))

    Jf = J + 0.02 * jnp.max(J, axis=1, keepdims=True)
    Gf = G + 0.02 * jnp.max(J, axis=1) * atm.ground_albedo[:, None]
    return _Guide(dilate(tsun).ravel(), Jf.ravel(), Gf.ravel(), cdf.ravel())


class _Start(NamedTuple):
    altitude: jax.Array
    up: jax.Array  # 3,P
    direction: jax.Array
    sun: jax.Array
    cap: jax.Array
    key: tuple
    index: jax.Array


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _add(*terms):
    """sum of scalar*vector"""
    return tuple(sum(k * v[i] for k, v in terms) for i in range(3))


def _normalise(v):
    k = jax.lax.rsqrt(_dot(v, v))
    return tuple(k * x for x in v)


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _select(c, a, b):
    return tuple(jnp.where(c, x, y) for x, y in zip(a, b))


def _frame(axis, sun):
    """e1 towards sun, e2"""
    e = _add((1, sun), (-_dot(axis, sun), axis))
    bad = _dot(e, e) < 1e-6
    flat = jnp.abs(axis[2]) < 0.9
    alt = (jnp.where(flat, 0.0, 1.0), jnp.zeros_like(axis[0]), jnp.where(flat, 1.0, 0.0))
    e = _normalise(_select(bad, _add((1, alt), (-_dot(axis, alt), axis)), e))
    return e, _cross(axis, e)


def _turn(axis, sun, c, phi):
    e1, e2 = _frame(axis, sun)
    s = safe_sqrt((1 - c) * (1 + c))
    return _normalise(_add((c, axis), (s * jnp.cos(phi), e1), (s * jnp.sin(phi), e2)))


NBIN = 2 * NQ * NAZ


def _bin_bounds(k, hor):
    """mu edges of bin row k"""
    kf = k.astype(hor.dtype)
    up = (kf - NQ) / NQ
    up1 = (kf + 1 - NQ) / NQ
    lo = jnp.where(k < NQ, -1 + (hor + 1) * (kf / NQ), hor + (1 - hor) * up * up)
    hi = jnp.where(k < NQ, -1 + (hor + 1) * ((kf + 1) / NQ), hor + (1 - hor) * up1 * up1)
    return lo, hi


def _guide_sample(g, cell, hor, x, y):
    base = cell * NBIN
    j = jnp.zeros_like(cell)
    step = 64
    while step:
        cand = j + step
        ok = (cand < NBIN) & (g.cdf[base + jnp.minimum(cand, NBIN) - 1] <= x)
        j = jnp.where(ok, cand, j)
        step //= 2
    hi = g.cdf[base + j]
    lo = jnp.where(j > 0, g.cdf[base + jnp.maximum(j - 1, 0)], 0)
    frac = jnp.clip(safe_divide(x - lo, hi - lo), 0, 1)
    k, a = j // NAZ, j % NAZ
    m0, m1 = _bin_bounds(k, hor)
    mu = m0 + (m1 - m0) * frac
    sign = jnp.where(y < 0.5, -1.0, 1.0).astype(mu.dtype)
    z = jnp.abs(2 * y - 1)
    phi = sign * (a.astype(mu.dtype) + z) * (np.pi / NAZ)
    return jnp.clip(mu, -1, 1), phi


def _guide_pdf(g, cell, hor, mu, cosphi):
    lower = mu < hor
    q = jnp.where(lower, (mu + 1) / (hor + 1), safe_sqrt((mu - hor) / jnp.maximum(1 - hor, 1e-6)))
    k = jnp.clip((q * NQ).astype(jnp.int32), 0, NQ - 1) + jnp.where(lower, 0, NQ)
    a = jnp.clip((jnp.arccos(jnp.clip(cosphi, -1, 1)) * (NAZ / np.pi)).astype(jnp.int32), 0, NAZ - 1)
    j = cell * NBIN + k * NAZ + a
    p = g.cdf[j] - jnp.where((k + a) > 0, g.cdf[jnp.maximum(j - 1, 0)], 0)
    m0, m1 = _bin_bounds(k, hor)
    return p / ((m1 - m0) * (2 * np.pi / NAZ))


def _march(atm, guide, seg, mu_s, nu, fc, jitter, end):
    """radiance expected from each panel, weighted by fc"""
    R, top = atm.bottom_radius, atm.top_altitude
    ext, sca = _coef(atm)
    r = R + seg.h
    PR, PM = phase.rayleigh(nu), phase.mie(nu, atm.mie_g, atm.mie_phase)

    def source(cell, n, cols):
        total = 0.0
        for k in range(ext.shape[1]):
            tau = ext[0, k] * cols[0] + ext[1, k] * cols[1] + ext[2, k] * cols[2]
            sr, sm = sca[0, k] * n[0], sca[1, k] * n[1]
            j = cell + k * (NH * NS)
            total += fc[k] * ((sr * PR + sm * PM) * guide.sun[j] + (sr + sm) * guide.diffuse[j]) * jnp.exp(-tau)
        return total

    def visit(g0, t0, t1, h1, n1, c0, c1):
        g1 = source(_cell(h1, (r * mu_s + t1 * nu) / (R + h1), top), n1, c1)
        return g1, (t0, t1, c0, g0, g1)

    z = jnp.zeros_like(seg.h)
    g = source(_cell(seg.h, mu_s, top), _densities(atm, seg.h), (z, z, z))
    cols, _, ys = _walk(atm, seg, jitter, end, visit, g)
    return cols, ys


def _balance(atm, guide, start, with_ground, hemisphere):
    """c [w,P]: one over expected radiance"""
    R, top = atm.bottom_radius, atm.top_altitude
    w = len(atm.wavelengths)
    h, mu, mu_s, nu = (
        start.altitude,
        _dot(start.up, start.direction),
        _dot(start.up, start.sun),
        _dot(start.direction, start.sun),
    )
    if hemisphere:
        cell = _cell(h, mu_s, top)
        return jnp.stack([1 / jnp.maximum(guide.diffuse[cell + k * NH * NS], 1e-30) for k in range(w)])
    ground = geometry.hits_ground(h, mu, R)
    seg = _segment(atm, h, mu, ground)
    end = jnp.minimum(start.cap, seg.length)
    gi = _cell(jnp.zeros_like(h), jnp.clip(((R + h) * mu_s + seg.length * nu) / R, -1, 1), top)

    def one(k):
        pick = (jnp.arange(w) == k).astype(h.dtype)
        cols, (t0, t1, _, a, b) = _march(atm, guide, seg, mu_s, nu, pick, jnp.full_like(h, 0.5), end)
        T = jnp.exp(
            -sum(
                x * y
                for x, y in zip((atm.rayleigh_scattering[k], atm.mie_extinction[k], atm.ozone_absorption[k]), cols)
            )
        )
        sees = ground & (start.cap >= seg.length) & with_ground
        return jnp.sum(0.5 * (t1 - t0) * (a + b), axis=0) + jnp.where(sees, T * guide.ground[gi + k * NS], 0)

    return safe_divide(jnp.ones((w,) + h.shape, h.dtype), jax.lax.map(one, jnp.arange(w)))


def _estimate(atm, guide, start, n, stride, log2n, with_ground, hemisphere, rho):
    """sums over samples per lane: [w,P]"""
    R, top = atm.bottom_radius, atm.top_altitude
    ext, sca = _coef(atm)
    w = ext.shape[1]
    P = start.altitude.shape[0]
    dtype = start.altitude.dtype
    lane = jnp.arange(P)
    solar = atm.solar_irradiance[:, None]
    albedo = atm.ground_albedo[:, None]
    M = PANELS + 1
    key = start.key
    cells = NH * NS

    def uni(index, dim):
        return _uniform(key, index, dim, log2n, dtype)

    c = _balance(atm, guide, start, with_ground, hemisphere)

    def body(state):
        h, u, d, f, vertex, index, total, steps = state
        first = vertex == 0
        base = vertex.astype(jnp.uint32) * np.uint32(3)
        h = jnp.where(first, start.altitude, h)
        u = _select(first, start.up, u)
        d0 = start.direction
        if hemisphere:
            base = base + np.uint32(2)
            d0 = _turn(
                start.up,
                start.sun,
                jnp.sqrt(uni(index, jnp.zeros_like(index))),
                2 * jnp.pi * uni(index, jnp.ones_like(index)),
            )
        d = _select(first, d0, d)
        f = jnp.where(first, 1, f)
        mu, mu_s, nu = (jnp.clip(q, -1, 1) for q in (_dot(u, d), _dot(u, start.sun), _dot(d, start.sun)))
        ground = geometry.hits_ground(h, mu, R)
        seg = _segment(atm, h, mu, ground)
        rnd = lambda k: _random(key, index, vertex.astype(jnp.uint32) * np.uint32(8) + np.uint32(k), dtype)
        cap = jnp.where(first, jnp.minimum(start.cap, seg.length), seg.length)
        PR, PM = phase.rayleigh(nu), phase.mie(nu, atm.mie_g, atm.mie_phase)
        r = R + h
        fc = tuple(f[k] * c[k] for k in range(w))
        cols_end, (t0, t1, c0, A, Bq) = _march(atm, guide, seg, mu_s, nu, fc, rnd(0), cap)
        Tend = jnp.exp(-_tau(ext, cols_end))
        mug = jnp.clip((r * mu_s + seg.length * nu) / R, -1, 1)
        gi = _cell(jnp.zeros_like(mug), mug, top)
        sees = ground & (cap >= seg.length) & (with_ground | ~first)
        g_ground = jnp.where(sees, sum(fc[k] * guide.ground[gi + k * NS] * Tend[k] for k in range(w)), 0)
        dt = t1 - t0
        m_panel = 0.5 * (A + Bq) * dt
        volume = jnp.sum(m_panel, axis=0)
        floor = (FLOOR / M) * volume
        m_panel = m_panel + jnp.where(dt > 0, floor, 0)
        cum = jnp.einsum("mk,kp->mp", jnp.tril(jnp.ones((M, M), dtype)), m_panel)
        mass = cum[-1] + g_ground
        rr = (volume + g_ground) / w
        q = jnp.where(first, 1, jnp.minimum(1, rr / rho))
        alive = (rnd(1) < q) & (mass > 0)
        x = uni(index, base) * mass
        on_ground = (x >= cum[-1]) & (g_ground > 0)
        j = jnp.minimum(jnp.sum(cum <= x, axis=0), M - 1)
        flat = j * P + lane
        pick = lambda a: a.reshape(-1)[flat]
        mj, cj, tj, dtj, a0, a1 = (pick(a) for a in (m_panel, cum, t0, dt, A, Bq))
        fl = safe_divide(floor, dtj)
        a0, a1 = a0 + fl, a1 + fl
        xi = jnp.clip(safe_divide(x - (cj - mj), mj), 0, 1)
        sl = safe_divide(a1 - a0, a1 + a0)
        y = jnp.minimum(2 * xi / jnp.maximum((1 - sl) + jnp.sqrt((1 - sl) * (1 - sl) + 4 * sl * xi), 1e-30), 1)
        pdf = (a0 + (a1 - a0) * y) / mass
        s_part = y * dtj
        ts = jnp.where(on_ground, seg.length, tj + s_part)
        n0 = _densities(atm, geometry.altitude_along(h, mu, tj, R))
        nm = _densities(atm, geometry.altitude_along(h, mu, tj + 0.5 * s_part, R))
        h2 = jnp.where(on_ground, 0, jnp.clip(geometry.altitude_along(h, mu, ts, R), 0, top))
        n_here = _densities(atm, h2)
        colt = tuple(pick(c0[s]) + s_part / 6 * (n0[s] + 4 * nm[s] + n_here[s]) for s in range(3))
        Tt = jnp.where(on_ground, Tend, jnp.exp(-_tau(ext, colt)))
        u2 = _normalise(_add((r, u), (ts, d)))
        mus2 = jnp.clip(_dot(u2, start.sun), -1, 1)
        bR, bM = sca[0][:, None] * n_here[0], sca[1][:, None] * n_here[1]
        weight = jnp.where(
            alive, f * Tt * safe_divide(jnp.where(on_ground, mass, 1), jnp.where(on_ground, g_ground, pdf)) / q, 0
        )
        Ts = _sun_transmittance(atm, h2, mus2, rnd(2)) * solar
        nee = weight * jnp.where(on_ground, albedo / jnp.pi * jnp.maximum(mus2, 0), bR * PR + bM * PM) * Ts
        total = total + nee
        # --- turn
        wR, wM = jnp.sum(c * weight * bR, 0), jnp.sum(c * weight * bM, 0)
        pM = BETA * safe_divide(wM, wR + wM)
        x2, x3 = uni(index, base + np.uint32(1)), uni(index, base + np.uint32(2))
        pG = (1 - pM) * ALPHA
        mie = x2 < pM
        gd = ~mie & (x2 < pM + pG) & ~on_ground
        xm = jnp.clip(safe_divide(x2, pM), 0, 1)
        xg = jnp.clip(safe_divide(x2 - pM, pG), 0, 1)
        xr = jnp.clip(safe_divide(x2 - pM - pG, 1 - pM - pG), 0, 1)
        cell2 = _cell(h2, mus2, top)
        hor2 = geometry.horizon_mu(h2, R)
        gmu, gphi = _guide_sample(guide, cell2, hor2, xg, x3)
        cos = jnp.where(mie, phase.sample_henyey_greenstein(xm, atm.mie_g), phase.sample_rayleigh(xr))
        cos = jnp.where(on_ground, jnp.sqrt(x2), jnp.where(gd, gmu, jnp.clip(cos, -1, 1)))
        d2 = _turn(_select(on_ground | gd, u2, d), start.sun, cos, jnp.where(gd, gphi, 2 * jnp.pi * x3))
        cos = jnp.clip(_dot(d, d2), -1, 1)
        mu2, nu2 = _dot(u2, d2), _dot(d2, start.sun)
        e_u, _ = _frame(u2, start.sun)
        cosphi = safe_divide(_dot(d2, e_u), safe_sqrt(1 - mu2 * mu2))
        pg = _guide_pdf(guide, cell2, hor2, mu2, cosphi)
        qR, qH, qM = (
            phase.rayleigh(cos),
            phase.henyey_greenstein(cos, atm.mie_g),
            phase.mie(cos, atm.mie_g, atm.mie_phase),
        )
        pdir = (1 - pM - pG) * qR + pM * qH + pG * pg
        f2 = weight * jnp.where(on_ground, albedo, (bR * qR + bM * qM) / pdir)
        alive = alive & (jnp.max(f2, axis=0) > 0)
        running = index < n
        return (
            h2,
            u2,
            d2,
            f2,
            jnp.where(alive, vertex + 1, 0),
            jnp.where(alive | ~running, index, index + np.uint32(stride)),
            jnp.where(running, total, state[6]),
            steps + jnp.sum(running),
        )

    z = jnp.zeros((w, P), dtype)
    state = (
        start.altitude,
        start.up,
        start.direction,
        z + 1,
        jnp.zeros(P, jnp.int32),
        start.index,
        z,
        jnp.zeros((), jnp.int32),
    )
    out = jax.lax.while_loop(lambda s: jnp.any(s[5] < n), body, state)
    return out[6], out[7]
