"""jaxsimp: plan how to grasp and move rope and cloth, on a laptop's CPU.

A goal (where every particle should end) is reduced to a few key points; they mask the action
tensor; a planner searches actions by rolling a population through differentiable dynamics.

Words and axes, everywhere: `N` particles, `K` key points, `T` actions in a plan, `G` pickers,
`B` population, `S` springs, `F` triangles; the last axis of length 3 is x, y, z with z up.
Units are SI. `key` is a JAX PRNG key, `num_*` a count, `*_fn` a callable.
"""
