"""The fingers' ends: what lies straight over them, and where witnesses looked at them.  Compiled."""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.doubts import Table, Told
from gripmon.belief.nodes import Nodes
from gripmon.belief.rows import log_sum, normal, strength_of
from gripmon.belief.state import LENGTHS, SIZE, Bank, Seen
from gripmon.belief.things import not_drawn
from gripmon.model.compiled import compiled
from gripmon.model.records import Array

_FIRST = LENGTHS.start
LOOKED_PX = 3.5
"""How far an end may be from where it was looked at: half of the reach of the search lines."""


@compiled
def lie_across(nodes: Nodes, i: int, bank: Bank, seen: Seen, table: Table, sizes: Array) -> None:
    """What a straight thing over the fingers' ends explains that edges apart don't: all of them are found as if the
    fingers were longer or shorter by one length; half of such things lie flush with the fingers, as jaws and tables
    align them, so that each is found there as exactly as the gripper's own, of others but for an edge's width.
    """
    near, missed, share, across, lasting = sizes[0], sizes[2], sizes[3], sizes[4], sizes[5]
    before = bank.doubts[nodes.parent[i]]
    for k in range(len(table.edges)):
        nodes.across[i, k] = 0.0
        of_ends = False
        for finger in range(len(table.ends)):
            of_ends = of_ends or (table.ends[finger] >> k) & 1 == 1
        if not of_ends:
            continue
        log, cross, along = np.zeros(2), np.zeros(2), np.zeros(2)  # flush, and but for an edge's width
        apart, rows, fresh = 0.0, 0, (before >> k) & 1 == 0
        for edge in range(len(seen.found)):
            of = max(seen.fitted[edge], 0)
            way = seen.rows[edge, of, 0, _FIRST] + seen.rows[edge, of, 0, _FIRST + 1]
            # An edge along the finger isn't that of a thing across: no length of it would take it out of the search.
            if not ((table.edges[k] >> edge) & 1 and seen.found[edge] > 0 and across * way * way > sizes[1]):
                continue
            apart += nodes.held[i, edge]
            fresh = fresh or not_drawn(bank, nodes.parent[i], edge)
            for row in range(2):
                way = seen.rows[edge, of, row, _FIRST] + seen.rows[edge, of, row, _FIRST + 1]
                missing = seen.lines[edge, of, row] - nodes.at[i, edge, row]
                variance = lasting + nodes.wide[i, edge, row] + strength_of(seen, edge, row) + seen.white[edge, of, row]
                for kind in range(2):
                    log[kind] += normal(missing, variance)
                    cross[kind] += way * missing / variance
                    along[kind] += way * way / variance
                    variance += near
                rows += 1
        share_now = share if fresh else missed * share
        if rows == 0 or share_now == 0.0:
            continue
        for kind in range(2):
            free = 1.0 + across * along[kind]
            log[kind] += 0.5 * (across * cross[kind] * cross[kind] / free - math.log(free)) - math.log(2.0)
        together = log_sum(log[0], log[1])
        nodes.across[i, k] = log_sum(math.log(1.0 - share_now), math.log(share_now) + together - apart)


@compiled
def look(nodes: Nodes, i: int, bank: Bank, told: Told, table: Table) -> None:
    """Where the witnesses looked at this node's ends: at the nearest place, if that is within what an end's probes
    cover, or where the fit is, if the node doesn't know its place so well, or nothing tells how far that is.
    """
    mean = bank.mean[nodes.parent[i]]
    for finger in range(len(table.ends)):
        ends, wide, scale, least = 0, 0.0, 0.0, LOOKED_PX
        for k in range(len(table.edges)):
            if (table.ends[finger] >> k) & 1 and not (table.all_ends >> k) & 1:
                ends |= table.edges[k]
        nodes.looked[i, finger] = -1
        for place in range(len(told.at)):
            most = 0.0
            for edge in range(len(told.rows)):
                if not (ends >> edge) & 1:
                    continue
                away = 0.0
                for j in range(SIZE):
                    away += told.rows[edge, j] * (mean[j] - told.at[place, j])
                    scale += abs(told.rows[edge, j])
                most = max(most, abs(away))
            if scale > 0.0 and most < least:
                nodes.looked[i, finger], least = place, most
        for edge in range(len(told.rows)):
            square = 0.0
            for j in range(SIZE if (ends >> edge) & 1 else 0):
                along = 0.0
                for k in range(j, SIZE):
                    along += nodes.root[i, k, j] * told.rows[edge, k]
                square += along * along
            wide = max(wide, square)
        if (wide > LOOKED_PX**2 or scale == 0.0) and len(told.at):
            nodes.looked[i, finger] = told.fit


@compiled
def across(nodes: Nodes, i: int, doubts: int) -> float:
    """The largest of what a set's doubts add."""
    most = 0.0
    for k in range(nodes.across.shape[1]):
        if (doubts >> k) & 1 and (most == 0.0 or nodes.across[i, k] > most):
            most = nodes.across[i, k]
    return most
