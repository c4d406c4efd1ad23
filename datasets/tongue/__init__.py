"""Find the frames that show the tongue: no head model of FLAME's layout has one, so they are not compared."""
