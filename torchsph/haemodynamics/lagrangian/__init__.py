"""Where blood goes: tracers carried by a flow, how long they stay, and the parts of a beat that they make up."""
