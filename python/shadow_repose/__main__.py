"""`python -m shadow_repose train …` is `shadow-repose train …`."""
from ._program import main

main()
