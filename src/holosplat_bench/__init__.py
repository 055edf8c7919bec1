"""The benchmark of holosplat: cases and scores, opponents that exist for its tables alone, the study of the thesis; and
the training of networks on scenes that are drawn as its cases are."""
