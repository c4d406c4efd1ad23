"""What lies on disk held against what it claims to be: verification of runs, evaluation of folders of images."""
