"""The commands of `cap4d`, a file each: `add` says how one is called; running it imports what it needs."""
