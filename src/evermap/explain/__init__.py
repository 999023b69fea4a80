"""What a recording contradicts and why: causes other than changes of landmarks, and the verdict on a run."""
