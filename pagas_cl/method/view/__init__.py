"""One view: whom to ask, the levels, whether what came out is believed; and rounds over many."""
