"""`python -m streamfeat`: the command line.

Lives here: the call alone. Not here: commands (`cli`).
"""

from streamfeat.cli import main

if __name__ == "__main__":
    main()
