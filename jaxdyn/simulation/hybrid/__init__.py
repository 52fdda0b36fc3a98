"""Motions with modes: contacts that open and close, friction that sticks and slips.

Within a mode the motion is constrained dynamics with rows that are active or not (`modes`, `dynamics`). `machine` makes the
steps and finds the events between modes, `transitions` says what a mode becomes, `replay` differentiates through events, and
`motion` is what `jd.simulate` calls.

The rows of all elements are always there, and the mode says by masks which ones act: one program serves all modes, and in a
batch each lane has its own.
"""
