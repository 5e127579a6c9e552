"""Jobs of the child: queued by operators, followed by a timer, applied to the scene."""
