"""A world for sealed trials of `ahrsd diagnose`, written from the continuous equations.

It imports nothing of `ahrsd` or of the judge, and they nothing of it (a test checks both): a tool
that is judged here cannot win by sharing a discretisation, a regressor or a sign with its examiner.

    curves      smooth functions of time with exact first and second derivatives
    motion      vehicles: attitude, body rate, position, specific force on a 1 kHz grid
    world       one vehicle in one field with motors, temperature, joint and switch
    chain       field -> iron -> sensor -> sample; what every effect may change
    on_sensor, in_world, on_gyro, on_link, outside    the effects, one function each
    limits      published detection limits, and the physical unit of each strength
    ideal       what an ideal observer could have seen: signal to noise with calibration removed
    noise       noise laws
    rings       which cases there are;  cases: one case
    semireal    real recordings with an effect added: bases, injected
    remainder   what a real recording has left of its own, and what stands out of it
"""
