"""Bringing the current plane up to date, on one thread or on several.

Lives here: whether there is anything to do, whether it is worth a thread, the order of the steps.
Not here: the steps (`kernels.update`, `kernels.planes`), how a step is shared (`threads`).
"""

from streamfeat.engine.threads import Crew
from streamfeat.kernels.layout import (
    CLOCK_DIRTY,
    CLOCK_PLANE,
    CLOCK_TOUCHED,
    CURSOR_CODED,
    Operator,
    State,
)
from streamfeat.kernels.planes import complete, finish, list_missing
from streamfeat.kernels.update import mark_dirty, renew, settle, update

__all__ = ["is_complete", "update_plane"]


def update_plane(operator: Operator, state: State, crew: Crew) -> None:
    """Make the current plane that of the counts; asks first, for a call of a kernel costs 10 us by itself."""
    if is_complete(operator, state) and not state.clock[CLOCK_TOUCHED]:
        return
    filters = operator.offset.shape[0]
    if not crew.is_worth_counting(_most_volumes(operator, state) * filters):
        update(operator, state)
        return
    mark_dirty(operator, state)
    renewing = crew.parts_for(int(state.clock[CLOCK_DIRTY]) * filters)
    crew.share(renew, renewing, operator, state)
    settle(state)
    list_missing(operator, state)
    completing = crew.parts_for(int(state.clock[CLOCK_DIRTY]) * filters)
    crew.share(complete, completing, operator, state)
    finish(max(renewing, completing), operator, state)


def is_complete(operator: Operator, state: State) -> bool:
    """Whether all volumes are in the current plane."""
    coded = state.cursors[state.clock[CLOCK_PLANE], CURSOR_CODED]
    return bool(coded == operator.shape[0] * operator.shape[1])


def _most_volumes(operator: Operator, state: State) -> int:
    """A bound of the volumes that an update has to work on."""
    volumes = operator.shape[0] * operator.shape[1]
    if not is_complete(operator, state):
        return volumes
    rows, columns = (-(-side // operator.stride) for side in operator.patch)
    covering = rows * columns
    return len(state.cursors) * min(volumes, int(state.clock[CLOCK_TOUCHED]) * covering)
