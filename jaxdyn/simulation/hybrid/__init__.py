"""Motion with modes: contacts that open and close, friction that sticks and slips, forces that are smooth in pieces.

Within a mode the motion is constrained dynamics with rows that are active or not (`modes`, `dynamics`). `system` is the hybrid
system: flow, guards and reset maps, with the mode transitions of `transitions`. `event_loop` makes the steps and locates the
events, `replay` differentiates through them, `motion` is the run of `jd.simulate`, and `piecewise` that of forces with kinks.

The rows of all elements are always there, and the mode says by masks which ones act: all modes have one program, and each
trajectory of a batch has its own.
"""
