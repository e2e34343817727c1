"""The step as plain loops compiled by numba: what `step` and its stages compute, without XLA.

Each module is named as its twin, from which it takes all constants; a stage that changes changes in both. It serves
preset "robust", forward only: derivatives, many runs at once, a GPU and preset "paper" are the twin's. Scans and maps
are in float32, x and y apart; the belief of a step is in float64, its matrices of 3 x 3 too.

`kept` can be asked without numba being imported; everything else imports it.
"""
