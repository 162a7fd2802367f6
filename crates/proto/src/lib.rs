//! The wire: code generated from proto/ and conversions to the cores' types.
