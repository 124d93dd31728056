"""What others do with noisy velocity volumes, small and by us, on the measurements that torchsph is judged by.

    python -m examples.rivals [NAME ...] [--noise measured noisy] [--tune] [--again] [--data DIR]

A rival is a function of a recording that returns velocities (T, 3, *shape), m/s. Its settings were chosen by `--tune`
on a ventricle of another shape, beat and seed (`tuning.py`), never on the phantom that it is judged on. Rows that are
there already are kept, so that a table that was cut off goes on where it stopped.
"""
