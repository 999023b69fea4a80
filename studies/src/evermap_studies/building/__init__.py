"""A building in space over four weeks: partial patrols by camera, things that come, move and go."""
