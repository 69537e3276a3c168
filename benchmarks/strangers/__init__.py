"""A folder of odd inputs, judged by what is right for each."""
