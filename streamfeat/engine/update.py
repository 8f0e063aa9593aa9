"""Bringing the current plane up to date step by step, so that threads can share the steps.

Lives here: whether there is anything to do, whether there is enough for several threads, the order of steps.
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
from streamfeat.kernels.update import mark_dirty, renew, settle

__all__ = ["is_complete", "is_little", "is_worth_sharing", "update_plane"]

LITTLE = 1 << 21
"""Filters times volumes of an update that idle time is used for: at most a millisecond and a half, which a
packet that comes meanwhile has to wait."""


def update_plane(operator: Operator, state: State, crew: Crew) -> None:
    """Make the current plane that of the counts; asks first, for each call of a kernel takes 6 us."""
    if is_complete(operator, state) and not state.clock[CLOCK_TOUCHED]:
        return
    filters = operator.offset.shape[0]
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


def is_worth_sharing(operator: Operator, state: State, crew: Crew) -> bool:
    """Whether there may be enough to do for several threads."""
    return crew.is_worth_counting(_most_work(operator, state))


def is_little(operator: Operator, state: State) -> bool:
    """Whether an update is certain to be short."""
    return _most_work(operator, state) <= LITTLE


def _most_work(operator: Operator, state: State) -> int:
    """Filters times a bound of the volumes to work on."""
    volumes = operator.shape[0] * operator.shape[1]
    if is_complete(operator, state):
        rows, columns = (-(-side // operator.stride) for side in operator.patch)
        volumes = len(state.cursors) * min(volumes, int(state.clock[CLOCK_TOUCHED]) * rows * columns)
    return int(volumes * operator.offset.shape[0])
