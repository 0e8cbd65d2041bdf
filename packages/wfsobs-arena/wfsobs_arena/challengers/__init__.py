"""Predictors and a controller from the literature that enter the arena, each in a module of its own."""

from __future__ import annotations

from wfsobs_arena.challengers.avc import AVC
from wfsobs_arena.challengers.base import Challenger
from wfsobs_arena.challengers.coupled_ar import COUPLED_AR
from wfsobs_arena.challengers.gru import GRU
from wfsobs_arena.challengers.imm import IMM
from wfsobs_arena.challengers.predictive import PREDICTIVE_RLS
from wfsobs_arena.challengers.rls import RLS
from wfsobs_arena.challengers.subspace import SUBSPACE

CHALLENGERS: dict[str, Challenger] = {one.algorithm.id: one for one in (RLS, COUPLED_AR, SUBSPACE, IMM, AVC, GRU, PREDICTIVE_RLS)}
"""By id, in the order of tables."""
