"""The experiments of Grønli 2017, chapters 4 and 5, run again: a picture and its numbers for each.

    python -m examples.figures [NAME ...] [--fast] [--again] [--out DIR] [--data DIR]

Each writes NAME.png and NAME.json. The JSON holds the numbers behind the picture, the settings, and for each thing
that was observed then whether it is seen here and the number that says so. A figure whose JSON was made by the present
code with the present settings is skipped, so that a redraw that was cut off goes on where it stopped.
"""
