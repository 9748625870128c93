"""The command `stereotruth`. In: a folder, what a user types. Out: sheets, remarks, runs."""
