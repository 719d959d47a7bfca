"""The live pages of NMSS Lab: choices and views, no mathematics."""
