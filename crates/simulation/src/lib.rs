//! All cores together in virtual time: the paper's tables.
