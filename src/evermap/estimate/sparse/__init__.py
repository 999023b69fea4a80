"""One sparse least-squares solver, of any variables: elimination tree, factorisation, selected inverse."""
