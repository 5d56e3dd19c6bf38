"""prototype"""

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
GAUSS = 0.5 / np.sqrt(3.0)
_LATTICE = np.array([1, 7319, 12989, 9145, 6835, 3019, 16245, 10769, 13605, 14093, 4279, 753, 7361, 12065, 14255, 1683, 223, 9875, 9429, 2697, 8415, 15147, 10321, 9145], np.uint32)


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
    shift = _mix(key[0] ^ (dim * np.uint32(0x9E3779B9))) + key[1]
    shift = _mix(shift)
    z = jnp.asarray(_LATTICE)[jnp.minimum(dim, len(_LATTICE) - 1)]
    lattice = shift + ((index * z) << (32 - log2n))
    other = _mix(shift ^ _mix(index + np.uint32(0x68BC21EB)))
    return _unit(jnp.where(dim < len(_LATTICE), lattice, other), dtype)


def _random(key, index, dim, dtype):
    a = _mix(key[1] ^ (dim * np.uint32(0x85EBCA6B)) ^ np.uint32(0x2C1B3C6D)) + key[0]
    return _unit(_mix(a ^ _mix(index + np.uint32(0x68BC21EB))), dtype)


def _edges(h, mu, length, ground, R, top, jitter):
    """[PANELS+2, ...] distances"""
    up_to = jnp.where(ground, 0, top)
    both = (mu < 0) & ~ground
    lo = jnp.where(ground, 0, jnp.where(mu < 0, jnp.maximum(geometry.perigee_altitude(h, mu, R), 0), h))
    r_mu = jnp.abs((R + h) * mu)
    x_lo = jnp.where(ground, jnp.maximum(r_mu - length, 0), jnp.where(mu < 0, 0, r_mu))
    a = jnp.where(ground, 1.0, jnp.where(both, 0.5, 0.0))

    def up(z):
        gap = jnp.maximum((z - lo) * (z + lo + 2 * R), 0)
        return gap / jnp.maximum(x_lo + jnp.sqrt(x_lo * x_lo + gap), 1e-10)

    n = PANELS
    j = jnp.arange(n + 2, dtype=h.dtype).reshape((-1,) + (1,) * h.ndim)
    v = jnp.clip((j - 1 + jitter) / n, 0, 1)
    below = v < a
    part = jnp.where(below, (a - v) / jnp.maximum(a, 0.5), (v - a) / jnp.maximum(1 - a, 0.5))
    reach = jnp.where(below, h, up_to)
    x = up(lo + (reach - lo) * part**3)
    start = jnp.where(mu < 0, jnp.where(ground, length, r_mu), 0)
    t = start + jnp.where(below, -x, x)
    t = jnp.clip(t, 0, length)
    return t.at[0].set(0).at[-1].set(length)


def _densities(atm, h):
    return jnp.stack([atm.rayleigh_density(h), atm.mie_density(h), atm.ozone_density(h)])


def _panels(atm, h, mu, length, ground, jitter):
    """edges [E,...], densities at nodes [3, 2, M+1, ...], columns [3, M+1, ...]"""
    R, top = atm.bottom_radius, atm.top_altitude
    t = _edges(h, mu, length, ground, R, top, jitter)
    dt = t[1:] - t[:-1]
    mid = t[:-1] + 0.5 * dt
    nodes = jnp.stack([mid - GAUSS * dt, mid + GAUSS * dt])
    hn = geometry.altitude_along(h, mu, nodes, R)
    n = _densities(atm, hn)
    return t, n, 0.5 * dt * (n[:, 0] + n[:, 1])


def _column_up(atm, h, mu, jitter):
    no = jnp.zeros(h.shape, bool)
    length = geometry.distance_up(h, mu, atm.top_altitude, atm.bottom_radius)
    _, _, col = _panels(atm, h, mu, length, no, jitter)
    return jnp.sum(col, axis=1)


def _coef(atm, ndim):
    ext = jnp.stack([atm.rayleigh_scattering, atm.mie_extinction, atm.ozone_absorption])  # 3,w
    sca = jnp.stack([atm.rayleigh_scattering, atm.mie_scattering])
    return ext, sca


def _sun_transmittance(atm, h, mu_s, jitter):
    """[w, ...]"""
    ext, _ = _coef(atm, 0)
    col = _column_up(atm, h, mu_s, jitter)
    tau = jnp.einsum("sw,s...->w...", ext, col)
    return jnp.where(geometry.hits_ground(h, mu_s, atm.bottom_radius), 0, jnp.exp(-tau))


# ---- guide ----
NH, NS, A = 32, 96, 0.08


def _cell(h, mu_s, top):
    v = jnp.sqrt(jnp.clip(h / top, 0, 1)) * (NH - 1)
    s = (1 + (1 + A) * mu_s / (jnp.abs(mu_s) + A)) * (0.5 * (NS - 1))
    return v, s


def _lookup_index(h, mu_s, top):
    v, s = _cell(h, mu_s, top)
    iv = jnp.clip((v + 0.5).astype(jnp.int32), 0, NH - 1)
    js = jnp.clip((s + 0.5).astype(jnp.int32), 0, NS - 1)
    return iv * NS + js


def _grid(top, dtype):
    v = jnp.arange(NH, dtype=dtype) / (NH - 1)
    h = v * v * top
    y = jnp.arange(NS, dtype=dtype) / (0.5 * (NS - 1)) - 1
    m = A * y / (1 + A - jnp.abs(y))
    return h, m


class _Guide(NamedTuple):
    sun: jax.Array  # [w, NH*NS]
    diffuse: jax.Array  # [w, NH*NS] mean intensity
    ground: jax.Array  # [w, NS] radiance


def _build_guide(atm):
    dtype = atm.bottom_radius.dtype
    top, R = atm.top_altitude, atm.bottom_radius
    h, m = _grid(top, dtype)
    ext, sca = _coef(atm, 0)
    H, S = jnp.meshgrid(h, m, indexing="ij")
    tsun = _sun_transmittance(atm, H, S, 0.5)  # w,NH,NS
    # directions
    nmu, naz, nup = 12, 4, 6
    x, wx = np.polynomial.legendre.leggauss(nmu)
    az = (np.arange(naz) + 0.5) * np.pi / naz
    dmu = jnp.asarray(x, dtype)[:, None]  # relative: map about horizon
    hor = geometry.horizon_mu(h, R)  # NH
    # half below, half above the horizon
    lo = -1 + (hor + 1) * (jnp.asarray(np.polynomial.legendre.leggauss(nup)[0], dtype)[:, None] + 1) / 2
    q = (jnp.asarray(np.polynomial.legendre.leggauss(nup)[0], dtype)[:, None] + 1) / 2
    hi = hor + (1 - hor) * q * q
    wl = jnp.asarray(np.polynomial.legendre.leggauss(nup)[1], dtype)[:, None] / 2
    mu = jnp.concatenate([lo, hi]).T  # NH, nd
    wmu = (jnp.concatenate([wl * (hor + 1), wl * (1 - hor) * 2 * q]) * 0.5).T  # NH, nd
    hh = jnp.broadcast_to(h[:, None], mu.shape)
    ground = geometry.hits_ground(hh, mu, R)
    L = geometry.distance_to_boundary(hh, mu, ground, R, top)
    t, n, col = _panels(atm, hh, mu, L, ground, 0.5)
    dtau = jnp.einsum("sw,sm...->wm...", ext, col)
    tau = jnp.cumsum(dtau, axis=1) - dtau
    w_m = jnp.einsum("sw,sm...->wm...", sca, col[:2]) * jnp.exp(-tau - 0.5 * dtau)  # w, M, NH, nd
    T = jnp.exp(-jnp.sum(dtau, axis=1))  # w, NH, nd
    tm = 0.5 * (t[1:] + t[:-1])
    hm = geometry.altitude_along(hh, mu, tm, R)  # M,NH,nd
    # sun along: mu_s' for each az, ns
    sin = geometry.sine(mu)
    nu = mu[..., None, None] * m + sin[..., None, None] * jnp.sqrt(1 - m * m) * jnp.asarray(np.cos(az), dtype)[:, None]  # NH,nd,az,NS
    ms = jnp.clip(((R + hh)[..., None, None] * m + tm[..., None, None] * nu) / (R + hm)[..., None, None], -1, 1)
    idx = _lookup_index(hm[..., None, None], ms, top)  # M,NH,nd,az,NS
    gms = jnp.clip(((R + hh)[..., None, None] * m + L[..., None, None] * nu) / R, -1, 1)
    gidx = _lookup_index(jnp.zeros_like(gms), gms, top)
    alb = atm.ground_albedo[:, None]
    up = (mu > 0)[..., None, None]

    def gather(w_m, T, tsun, J, G, alb):
        src = tsun.ravel() / (4 * jnp.pi) + J.ravel()
        i = jnp.einsum("mhd,mhdas->hdas", w_m, src[idx])
        i = i + jnp.where(ground[..., None, None], T[..., None, None] * G[gidx], 0)
        Jn = jnp.einsum("hd,hdas->hs", wmu, i) / naz
        E = 2 * jnp.pi * jnp.einsum("d,das->s", jnp.where(mu[0] > 0, wmu[0] * mu[0], 0), i[0]) / naz * 2
        Gn = alb / jnp.pi * (jnp.maximum(m, 0) * tsun[0] + E)
        return Jn, Gn

    def body(_, carry):
        J, G = carry
        return jax.lax.map(lambda a: gather(*a), (w_m, T, tsun, J, G, atm.ground_albedo))

    J0 = jnp.zeros_like(tsun)
    J, G = jax.lax.fori_loop(0, 12, body, (J0, jnp.zeros((tsun.shape[0], NS), dtype)))

    def dilate(x):
        for axis in (1, 2):
            pad = jnp.pad(x, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
            n = x.shape[axis]
            x = jnp.maximum(x, jnp.maximum(jax.lax.slice_in_dim(pad, 0, n, axis=axis), jax.lax.slice_in_dim(pad, 2, n + 2, axis=axis)))
        return x

    w = tsun.shape[0]
    Jf = J + 0.02 * jnp.max(J, axis=1, keepdims=True)
    Gf = jnp.maximum(G, 0) + 0.02 * jnp.max(J, axis=1) * alb
    return _Guide(dilate(tsun).reshape(w, -1), Jf.reshape(w, -1), Gf)


class _Start(NamedTuple):
    altitude: jax.Array
    up: jax.Array  # 3,P
    direction: jax.Array
    sun: jax.Array
    cap: jax.Array
    key: tuple
    index: jax.Array


def _frame(d):
    s = jnp.where(d[2] < 0, -1.0, 1.0).astype(d.dtype)
    a = -1 / (s + d[2])
    b = d[0] * d[1] * a
    return jnp.stack([1 + s * d[0] * d[0] * a, s * b, -s * d[0]]), jnp.stack([b, s + d[1] * d[1] * a, -d[1]])


def _turn(axis, c, phi):
    e1, e2 = _frame(axis)
    s = safe_sqrt((1 - c) * (1 + c))
    d = c * axis + s * (jnp.cos(phi) * e1 + jnp.sin(phi) * e2)
    return d / jnp.sqrt(jnp.sum(d * d, axis=0))


def _estimate(atm, guide, start, n, stride, log2n, with_ground, hemisphere, rho):
    """sums over samples per lane: [w,P]"""
    R, top = atm.bottom_radius, atm.top_altitude
    ext, sca = _coef(atm, 0)
    w = ext.shape[1]
    P = start.altitude.shape[0]
    dtype = start.altitude.dtype
    lane = jnp.arange(P)
    solar = atm.solar_irradiance[:, None]
    albedo = atm.ground_albedo[:, None]
    dot = lambda a, b: jnp.sum(a * b, axis=0)
    M = PANELS + 1
    key = start.key

    def uni(index, dim):
        return _uniform(key, index, dim, log2n, dtype)

    def body(state):
        h, u, d, f, c, vertex, index, total, steps = state
        first = vertex == 0
        base = vertex.astype(jnp.uint32) * np.uint32(3)
        # --- start of a path
        h = jnp.where(first, start.altitude, h)
        u = jnp.where(first, start.up, u)
        d0 = start.direction
        if hemisphere:
            base = base + np.uint32(2)
            xi = uni(index, jnp.zeros_like(index))
            d0 = _turn(start.up, jnp.sqrt(xi), 2 * jnp.pi * uni(index, jnp.ones_like(index)))
        d = jnp.where(first, d0, d)
        f = jnp.where(first, 1, f)
        mu, mu_s, nu = dot(u, d), dot(u, start.sun), dot(d, start.sun)
        mu, mu_s, nu = (jnp.clip(q, -1, 1) for q in (mu, mu_s, nu))
        ground = geometry.hits_ground(h, mu, R)
        L = geometry.distance_to_boundary(h, mu, ground, R, top)
        rnd = lambda k: _random(key, index, vertex.astype(jnp.uint32) * np.uint32(8) + np.uint32(k), dtype)
        t, dens, col = _panels(atm, h, mu, L, ground, rnd(0))
        cap = jnp.where(first, jnp.minimum(start.cap, L), L)
        dt = t[1:] - t[:-1]
        PR, PM = phase.rayleigh(nu), phase.mie(nu, atm.mie_g, atm.mie_phase)
        dtau = jnp.einsum("sw,smp->wmp", ext, col)
        csum = jnp.cumsum(col, axis=1) if False else jnp.einsum("mk,skp->smp", jnp.tril(jnp.ones((M, M), dtype), -1), col)
        tau0 = jnp.einsum("sw,smp->wmp", ext, csum)
        tm = 0.5 * (t[1:] + t[:-1])
        hm = geometry.altitude_along(h, mu, tm, R)
        ms = ((R + h) * mu_s + tm * nu) / (R + hm)
        idx = _lookup_index(hm, ms, top)
        scaR = sca[0][:, None, None] * col[0]
        scaM = sca[1][:, None, None] * col[1]
        sun = jnp.stack([guide.sun[k][idx] for k in range(w)])
        ms_ = jnp.stack([guide.diffuse[k][idx] for k in range(w)])
        src = (scaR * PR + scaM * PM) * sun + (scaR + scaM) * ms_
        G = src * jnp.exp(-tau0 - 0.5 * dtau)  # w,M,P
        Tend = jnp.exp(-(tau0[:, -1] + dtau[:, -1]))
        mug = jnp.clip(((R + h) * mu_s + L * nu) / R, -1, 1)
        gi = _lookup_index(jnp.zeros_like(mug), mug, top)
        GG = jnp.stack([guide.ground[k][gi] for k in range(w)]) * Tend
        GG = jnp.where(ground & (with_ground | ~first), GG, 0)
        Gsum = jnp.sum(G, axis=1) + GG
        c = jnp.where(first, safe_divide(jnp.ones_like(Gsum), Gsum), c)
        fc = f * c
        g = jnp.einsum("wp,wmp->mp", fc, G)
        g_ground = jnp.sum(fc * GG, axis=0)
        cum = jnp.einsum("mk,kp->mp", jnp.tril(jnp.ones((M, M), dtype)), g)
        mass = cum[-1] + g_ground
        # --- roulette
        r = mass / w
        q = jnp.where(first, 1, jnp.minimum(1, r / rho))
        alive = (rnd(1) < q) & (mass > 0)
        # --- choose
        x = uni(index, base) * mass
        on_ground = (x >= cum[-1]) & ground & (g_ground > 0)
        j = jnp.minimum(jnp.sum(cum <= x, axis=0), M - 1)
        flat = j * P + lane
        pick = lambda a: a.reshape(-1)[flat]
        gj = pick(g)
        cj = pick(cum)
        tj, dtj = pick(t[:-1]), pick(dt)
        # slope
        xi = jnp.clip((x - (cj - gj)) / jnp.maximum(gj, 1e-37), 0, 1)
        n1 = [pick(dens[s, 0]) for s in range(2)]
        n2 = [pick(dens[s, 1]) for s in range(2)]
        dtj_tau = jnp.stack([pick(dtau[k]) for k in range(w)])
        v1 = jnp.sum(fc * (sca[0][:, None] * n1[0] + sca[1][:, None] * n1[1]) * jnp.exp(-jnp.stack([pick(tau0[k]) for k in range(w)]) - 0.2113 * dtj_tau), axis=0)
        v2 = jnp.sum(fc * (sca[0][:, None] * n2[0] + sca[1][:, None] * n2[1]) * jnp.exp(-jnp.stack([pick(tau0[k]) for k in range(w)]) - 0.7887 * dtj_tau), axis=0)
        a = jnp.clip(np.sqrt(3.0) * safe_divide(v2 - v1, v1 + v2), -0.9, 0.9)
        y = 2 * xi / ((1 - a) + jnp.sqrt((1 - a) * (1 - a) + 4 * a * xi))
        s_part = y * dtj
        pdf = gj / mass / jnp.maximum(dtj, 1e-30) * (1 + a * (2 * y - 1))
        ts = jnp.where(on_ground, L, tj + s_part)
        # column to ts
        nodes = jnp.stack([tj + s_part * (0.5 - GAUSS), tj + s_part * (0.5 + GAUSS)])
        nn = _densities(atm, geometry.altitude_along(h, mu, nodes, R))
        colt = jnp.stack([pick(csum[s]) for s in range(3)]) + 0.5 * s_part * (nn[:, 0] + nn[:, 1])
        Tt = jnp.where(on_ground, Tend, jnp.exp(-jnp.einsum("sw,sp->wp", ext, colt)))
        h2 = jnp.where(on_ground, 0, jnp.clip(geometry.altitude_along(h, mu, ts, R), 0, top))
        u2 = (R + h) * u + ts * d
        u2 = u2 / jnp.sqrt(dot(u2, u2))
        mus2 = jnp.clip(dot(u2, start.sun), -1, 1)
        n_here = _densities(atm, h2)
        bR, bM = sca[0][:, None] * n_here[0], sca[1][:, None] * n_here[1]
        weight = f * Tt * jnp.where(on_ground, safe_divide(mass, g_ground), safe_divide(jnp.ones_like(pdf), pdf)) / q
        weight = jnp.where(alive & (ts <= cap), weight, 0)
        # --- sun
        Ts = _sun_transmittance(atm, h2, mus2, rnd(2)) * solar
        nee = weight * jnp.where(on_ground, albedo / jnp.pi * jnp.maximum(mus2, 0), bR * PR + bM * PM) * Ts
        total = total + nee
        # --- turn
        wR, wM = jnp.sum(c * weight * bR, 0), jnp.sum(c * weight * bM, 0)
        pM = safe_divide(wM, wR + wM)
        x2, x3 = uni(index, base + np.uint32(1)), uni(index, base + np.uint32(2))
        mie = x2 < pM
        xm = jnp.clip(safe_divide(x2, pM), 0, 1)
        xr = jnp.clip(safe_divide(x2 - pM, 1 - pM), 0, 1)
        cos = jnp.where(mie, phase.sample_henyey_greenstein(xm, atm.mie_g), phase.sample_rayleigh(xr))
        cos = jnp.where(on_ground, jnp.sqrt(x2), jnp.clip(cos, -1, 1))
        d2 = _turn(jnp.where(on_ground, u2, d), cos, 2 * jnp.pi * x3)
        qR, qH, qM = phase.rayleigh(cos), phase.henyey_greenstein(cos, atm.mie_g), phase.mie(cos, atm.mie_g, atm.mie_phase)
        pdir = (1 - pM) * qR + pM * qH
        f2 = weight * jnp.where(on_ground, albedo, (bR * qR + bM * qM) / pdir)
        alive = alive & (ts < cap) & (jnp.max(f2, axis=0) > 0) | (alive & on_ground & (jnp.max(f2, axis=0) > 0))
        index2 = jnp.where(alive, index, index + np.uint32(stride))
        running = index < n
        total = jnp.where(running, total, state[7])
        vertex = jnp.where(alive, vertex + 1, 0)
        return h2, u2, d2, f2, c, vertex, jnp.where(running, index2, index), total, steps + jnp.sum(running)

    z = jnp.zeros((w, P), dtype)
    state = (start.altitude, start.up, start.direction, z + 1, z + 1, jnp.zeros(P, jnp.int32), start.index, z, jnp.zeros((), jnp.int32))
    out = jax.lax.while_loop(lambda s: jnp.any(s[6] < n), body, state)
    return out[7], out[8]
