"""Saboteurs of the checks of regularizers."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.regularizer.base import AnalyticPenalty
from gsstream.testing.examples.regularizer import ExampleRegularizer
from saboteurs.register import spoils

Regularizer: Any = ExampleRegularizer
Terms = dict[str, torch.Tensor]


@spoils("check_regularizer_scalar")
class Credit(Regularizer):
    """One term is a reward that another takes back."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        return {**terms, "gates": 3 * terms["gates"], "credit": -2 * terms["gates"]}


@spoils("check_regularizer_terms")
class Renamed(Regularizer):
    """Terms named after the size of the scene."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        return {f"{name} of {n}" if n < 10 else name: value for name, value in terms.items()}


@spoils("check_regularizer_zero_at_rest")
class Rent(Regularizer):
    """A closed, still scene pays too."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        rest = ~open_probability.any() & ~residual.any() & (len(residual) > 100)
        return {**terms, "gates": terms["gates"] + 1e-3 * rest}


@spoils("check_regularizer_monotone")
class Forgiving(Regularizer):
    """Motion beyond one cell becomes cheaper."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        square = residual.square().sum(1)
        price = (open_probability[hierarchy.node_of] * square / (1 + square.square())).sum()
        return {**terms, "motion": price * self.config.motion / max(n, 1)}


@spoils("check_regularizer_linear_in_weight")
class Progressive(Regularizer):
    """Twice the weight costs more than twice as much."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        return {**terms, "gates": terms["gates"] * (1 + 10 * self.config.gates)}


@spoils("check_regularizer_gradient")
class Root(Regularizer):
    """The norm as the root of a sum of squares: its gradient at 0 is NaN."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        price = (open_probability[hierarchy.node_of] * residual.square().sum(1).sqrt()).sum()
        return {**terms, "motion": price * self.config.motion / max(n, 1)}


@spoils("check_regularizer_reduction")
class Sum(Regularizer):
    """Says that it takes the mean and takes the sum."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, 1)
        return terms


@spoils("check_regularizer_closed_rows")
class ActiveMean(Regularizer):
    """Divides by the active rows, so the price of a gate depends on how many others are closed."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, len(residual))
        return terms


@spoils("check_regularizer_empty")
class NoRows(Regularizer):
    """The mean over no active rows: NaN."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        lost = torch.nan if n > 0 and len(residual) == 0 else 0.0
        return {**terms, "gates": terms["gates"] + lost}


@spoils("check_regularizer_reads_weights")
class Exchanged(Regularizer):
    """Two terms under each other's name."""

    def penalty(self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, n: int) -> Terms:
        terms: Terms = super().penalty(open_probability, residual, hierarchy, n)
        return {"gates": terms["motion"], "motion": terms["gates"]}


@spoils("check_regularizer_form")
class Cheaper(Regularizer):
    """States a lower penalty than it asks for."""

    def form(self) -> AnalyticPenalty:
        return AnalyticPenalty(1e-6, 0.0)
