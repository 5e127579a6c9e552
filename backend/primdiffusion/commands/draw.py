"""Draw a frame for an engine or a viewport: `draw` of JSON-RPC."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from primdiffusion.commands.frame import Frame
from primdiffusion.commands.progress import Report

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session


@dataclasses.dataclass(frozen=True)
class DrawRequest(Frame):
    """Fill a frame. Needs no checkpoint."""

    def run(self, session: Session, report: Report) -> dict[str, Any]:
        """See `FrameDrawer.draw`."""
        from primdiffusion.commands.frame_drawer import FrameDrawer  # torch is loaded late

        return session.kept(FrameDrawer).draw(self, report)
