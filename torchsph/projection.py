"""One time step of the incompressible scheme: predict with viscosity, project, move."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .integrate import Stepper, Surroundings
from .pairs.interface import MomentumTerms, RateTerms, per_particle
from .particles import Particles
from .poisson import PoissonProblem, PoissonSolution, solve
from .walls import WallSample, friction

class ProjectionStepper(Stepper):
    def step(self, particles, step, number, around):
        dt = per_particle(step, particles.member)
        wall = around.sample(particles)
        pairs = self.pair_search.at(particles)
        body = around.body_force(particles)
        fluid = particles.fluid[:, None]
        acc = torch.zeros_like(particles.velocity)
        if self.coefficients.viscosity is not None:
            lam = MomentumTerms(pressure=None, laminar=self.momentum_terms.laminar, artificial=self.momentum_terms.artificial)
            acc = self.pair_search.backend.momentum(pairs, self._pressureless(particles), self.support, lam)
            if wall is not None and self.scheme.wall.no_slip:
                nu = per_particle(self.coefficients.viscosity, particles.member)
                acc = acc + friction(nu, particles.velocity, wall)
            if wall is not None:
                acc = acc / wall.share.clamp_min(.1)[:, None]
        if body is not None: acc = acc + body
        particles = particles.changed(velocity=torch.where(fluid, particles.velocity + dt[:, None]*acc, particles.velocity))
        start = particles.pressure if particles.pressure is not None else torch.zeros_like(particles.mass)
        velocity, solution, crowding = self.project(particles, pairs, wall, start*dt if False else start, self.tol)
        particles = particles.changed(velocity=velocity, pressure=solution.pressure)
        self.iters.append(solution.iterations.max().item())
        class R: xsph=None
        drift = dt[:, None]*velocity + self.wandering(particles, R, crowding, step, particles)
        if self.every and (self.count % self.every) == 0:
            move, _, sol = packing(self, particles, pairs, wall, iterations=10)
            drift = drift + self.frac*move
        self.count += 1
        return particles.changed(position=particles.position + drift), acc, wall

    tol = 1e-2
    tau = None
    every = 0
    frac = .5
    count = 0
    iters: list = []

    def project(self, particles, pairs, wall, start, tolerance):
        backend = self.pair_search.backend
        state = self._pressureless(particles)
        rates = backend.rates(pairs, state, self.support, RateTerms(continuity="volume", concentration=True, shepard=self.tau is not None))
        divergence, crowding = self._complete(particles, rates, wall)
        share = wall.share.clamp_min(.1) if wall is not None else torch.ones_like(divergence)
        if self.tau is not None:
            n = rates.shepard_volume/share
            divergence = divergence - (n-1).clamp(-.3,.3)/self.tau
        fluid = particles.fluid
        apply = lambda f: backend.laplacian(pairs, state, self.support, f, fluid)[0]
        _, diagonal = backend.laplacian(pairs, state, self.support, start, fluid)
        problem = PoissonProblem(apply, diagonal, particles.mass, fluid,
            torch.ones(particles.members, dtype=torch.bool), particles.member, particles.members)
        sol = solve(problem, -divergence*share, start, tolerance=tolerance, iterations=200)
        phi = ProjectionStepper._extended(self, particles, pairs, sol.pressure)
        form = getattr(self.scheme, "projection_form", "difference")
        grad = backend.momentum(pairs, particles.state(phi), self.support, MomentumTerms(pressure="difference"))
        grad = grad/share[:, None]
        return torch.where(fluid[:, None], particles.velocity + grad, particles.velocity), sol, crowding

    def start(self, *a):
        class T: pass
        t, self.tau = ProjectionStepper.tau, None
        out = ProjectionStepper.project(self,*a); self.tau=t
        return out

    def _extended(self, particles, pairs, pressure):
        fluid = particles.fluid
        if bool(fluid.all()): return pressure
        backend = self.pair_search.backend
        one = torch.where(fluid, particles.mass, torch.zeros_like(pressure))
        def sums(mass):
            st = particles.changed(mass=mass).state(pressure)
            return backend.rates(pairs, st, self.support, RateTerms(continuity=None, shepard=True)).shepard_mass
        w = sums(one); wp = sums(one*pressure)
        return torch.where(fluid, pressure, wp/w.clamp_min(1e-6))


def packing(self, particles, pairs, wall, tolerance=3e-2, iterations=30):
    """Displacement (N, D) that evens out the number density, by one linearised projection."""
    backend = self.pair_search.backend
    state = self._pressureless(particles)
    share = wall.share.clamp_min(.1)
    rates = backend.rates(pairs, state, self.support, RateTerms(continuity=None, shepard=True))
    fluid = particles.fluid
    n = rates.shepard_volume/share
    apply = lambda f: backend.laplacian(pairs, state, self.support, f, fluid)[0]
    zero = torch.zeros_like(n)
    _, diagonal = backend.laplacian(pairs, state, self.support, zero, fluid)
    problem = PoissonProblem(apply, diagonal, particles.mass, fluid,
        torch.ones(particles.members, dtype=torch.bool), particles.member, particles.members)
    sol = solve(problem, (n-1).clamp(-.3,.3)*share, zero, tolerance=tolerance, iterations=iterations)
    phi = self._extended(particles, pairs, sol.pressure) if hasattr(self, "_extended") else ProjectionStepper._extended(self, particles, pairs, sol.pressure)
    move = backend.momentum(pairs, particles.state(phi), self.support, MomentumTerms(pressure="difference"))/share[:, None]
    move = torch.where(fluid[:, None], move, torch.zeros_like(move))
    length = move.norm(dim=1, keepdim=True)
    return move*(0.2/length.clamp_min(.2)), n, sol
