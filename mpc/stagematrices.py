"""The matrices of a stagewise QP: what the A_i and B_i of a horizon make of its cost and its constraints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix

from mpc.stages import Layout, Pattern, Rows, condense_stages
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Matrices:
    """What the A_i and B_i of a horizon make of the QP; to be used for as many periods as these hold.

    Attributes:
        A: (N, n, n), A_i.
        B: (N, n, nu), B_i.
        head: (1, L + 1, n, L nu) slopes of the states of the first stage by v_0.
        tail: (J - 1, M + 1, n, n + M nu) those of the others by [s_j, v_j].
        first: (1, L n_r, L nu) slopes of the weighted outputs at the first stage's states but its last.
        later: (J - 1, M n_r, n + M nu) likewise of the other stages.
        P: cost.
        dynamics: equality rows.
        rows: inequality rows.
    """

    A: Array
    B: Array
    head: Array
    tail: Array
    first: Array
    later: Array
    P: csc_matrix
    dynamics: csc_matrix
    rows: csc_matrix


class MatrixBuilder:
    """Fixes the pattern of the matrices once, then fills in their values.

    Args:
        at: where the variables are.
        rows: the inequality rows.
        regulated: (n_r, n) root of Q_y times C_r.
        input_weight: (nu, nu) 2 Q_u.
        move_weight: (nu, nu) 2 Q_d.
        slack_weight: (N n_s,) 2 l2 of each slack.
    """

    def __init__(
        self, at: Layout, rows: Rows, regulated: Array, input_weight: Array, move_weight: Array, slack_weight: Array
    ) -> None:
        self._at, self._rows, self._regulated = at, rows, regulated
        self._input_weight, self._move_weight = input_weight, move_weight
        self._slack_weight = slack_weight[:, None, None]
        self._input_costs = {steps: self._input_cost(steps) for steps in (at.L, at.M)}

        # Of numbers in general position an entry is zero only where it always is.
        rng = np.random.default_rng(0)
        A, B = (rng.normal(size=(at.N, at.n, width)) for width in (at.n, at.nu))
        head, tail = self._slopes(A, B)
        first, later = self._weighted(head, at.L), self._weighted(tail, at.M)
        slack, ends, outputs = at.slacks.reshape(-1, 1), at.ends, rows.outputs
        self._P = Pattern(
            (at.size, at.size),
            [
                (at.head, at.head),
                (at.tail, at.tail),
                (at.starts[-1], at.starts[-1]),
                (slack, slack),
                (at.lasts, at.firsts),
                (at.firsts, at.lasts),
            ],
            self._costs(first, later),
        )
        self._A = Pattern(
            (ends.size, at.size),
            [(ends[:1], at.head), (ends[1:], at.tail), (ends, at.starts)],
            self._dynamics(head, tail),
        )
        self._G = Pattern(
            (rows.h_l.size, at.size),
            [
                (outputs[: at.L - 1], at.head),
                (outputs[at.L - 1 : -1].reshape(len(at.tail), at.M, len(rows.C)), at.tail[:, None]),
                (outputs[-1], at.starts[-1]),
                (outputs, at.slacks),
                (rows.slews[:, None], rows.slewing[:, None]),
                (rows.slews[rows.limited.size :, None], rows.slewing[: -rows.limited.size, None]),
            ],
            self._outputs(head, tail),
        )

    def build(self, A: Array, B: Array) -> Matrices:
        """The matrices.

        Args:
            A: (N, n, n), A_i.
            B: (N, n, nu), B_i.
        """
        at = self._at
        head, tail = self._slopes(A, B)
        first, later = self._weighted(head, at.L), self._weighted(tail, at.M)
        return Matrices(
            A=A,
            B=B,
            head=head,
            tail=tail,
            first=first,
            later=later,
            P=self._P.matrix(self._costs(first, later)),
            dynamics=self._A.matrix(self._dynamics(head, tail)),
            rows=self._G.matrix(self._outputs(head, tail)),
        )

    def _slopes(self, A: Array, B: Array) -> tuple[Array, Array]:
        """`head` and `tail` of `Matrices`."""
        at = self._at
        start = np.zeros((1, at.n, at.head.size + 1))
        free = np.zeros((len(at.tail), at.n, at.tail.shape[1] + 1))
        free[:, :, : at.n] = np.eye(at.n)
        head, tail = condense(at, start, free, A, B, np.zeros((at.N, at.n)))
        return head[..., :-1], tail[..., :-1]

    def _weighted(self, slopes: Array, steps: int) -> Array:
        """`first` or `later` of `Matrices`."""
        return (self._regulated @ slopes[:, :-1]).reshape(len(slopes), steps * len(self._regulated), slopes.shape[3])

    def _costs(self, first: Array, later: Array) -> list[Array]:
        """P's blocks."""
        at = self._at
        blocks = [self._stage_cost(first, at.L), self._stage_cost(later, at.M)]
        (blocks[1] if len(later) else blocks[0])[-1, -at.nu :, -at.nu :] -= self._move_weight  # none follows the last
        across = np.broadcast_to(-self._move_weight, (len(at.lasts), at.nu, at.nu))
        end = 2.0 * self._regulated.T @ self._regulated
        return [*blocks, end, self._slack_weight, across, across.transpose(0, 2, 1)]

    def _stage_cost(self, slopes: Array, steps: int) -> Array:
        """Hessian of stages' cost, the end state's left out."""
        hessian = 2.0 * slopes.transpose(0, 2, 1) @ slopes
        weights = self._input_costs[steps]
        hessian[:, -len(weights) :, -len(weights) :] += weights
        return hessian

    def _input_cost(self, steps: int) -> Array:
        """Hessian of the cost of a stage's inputs, of changes both from the stage before and to the one after."""
        itself, beside = np.eye(steps), np.eye(steps, k=1) + np.eye(steps, k=-1)
        cost: Array = np.kron(itself, self._input_weight + 2.0 * self._move_weight) - np.kron(beside, self._move_weight)
        return cost

    def _dynamics(self, head: Array, tail: Array) -> list[Array]:
        """The equality rows' blocks: each stage's end is the next one's start."""
        starts = np.broadcast_to(np.eye(self._at.n), (len(self._at.starts), self._at.n, self._at.n))
        return [-head[:, -1], -tail[:, -1], starts]

    def _outputs(self, head: Array, tail: Array) -> list[Array]:
        """G's blocks."""
        rows = self._rows
        slack = np.broadcast_to(rows.slack, (self._at.N, *rows.slack.shape))
        ones = np.ones((rows.slews.size, 1, 1))
        return [rows.C @ head[0, 1:-1], rows.C @ tail[:, :-1], rows.C, slack, ones, -ones[rows.limited.size :]]


def condense(at: Layout, start: Array, free: Array, *steps: Array) -> tuple[Array, Array]:
    """The first stage from `start` and the others from `free` on; see `mpc.stages.condense_stages`."""
    head = condense_stages(start, *(part[None, : at.L] for part in steps))
    return head, condense_stages(free, *(part[at.L :].reshape(len(free), at.M, *part.shape[1:]) for part in steps))
