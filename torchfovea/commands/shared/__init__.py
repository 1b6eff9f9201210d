"""What several commands share: from settings to objects, run folders, workers, words for mistakes."""
