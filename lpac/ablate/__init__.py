"""What each part of a method is worth: policies that are trained, or fly, without it."""
