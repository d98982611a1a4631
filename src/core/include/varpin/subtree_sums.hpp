// Storage for the elimination of bodies, from the last to the first, and for coordinates that several bodies share.
// docs/mathematics.md, "Linear in the number of joints".
#pragma once

#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include "varpin/tree.hpp"

namespace varpin {

// Mimic joints: coordinates that move several bodies, because mimic joints follow them. Such a coordinate cannot be
// eliminated with one of its bodies. From the first of its bodies on, the matrices that bodies pass to their parents
// have a row and a column for it, its slot. It is eliminated at the body whose subtree has all of its bodies. Slots are
// reused.
struct Mimics {
    struct Mimic {
        int coordinate = 0;
        int slot = 0;
        int body = 0;  // the first body that it moves
    };

    explicit Mimics(const Tree& tree) : slot(tree.dof(), -1), ending_(tree.size() + 1) {
        if (tree.size() == tree.dof()) return;
        std::vector<std::vector<int>> moved(tree.dof());
        for (int j = 0; j < tree.size(); ++j) moved[tree.bodies[j].coordinate].push_back(j);
        // From the root on, for the smallest number of slots.
        std::vector<std::pair<int, int>> tops;
        for (int c = 0; c < tree.dof(); ++c) {
            if (moved[c].size() < 2) continue;
            int top = moved[c][0];
            for (int j : moved[c]) top = common(tree, top, j);
            tops.emplace_back(top, c);
        }
        std::sort(tops.begin(), tops.end());
        std::vector<std::vector<char>> taken;  // (slots) for each body, slots in use in the matrix it passes on
        for (const auto& [top, c] : tops) {
            std::vector<char> bordered(tree.size() + 1);
            for (int j : moved[c]) {
                for (; j > top; j = tree.bodies[j].parent) bordered[j + 1] = 1;
            }
            bordered[top + 1] = 1;
            const auto meets = [&bordered](const std::vector<char>& others) {
                for (std::size_t k = 0; k < others.size(); ++k) {
                    if (others[k] && bordered[k]) return true;
                }
                return false;
            };
            int& chosen = slot[c];
            for (chosen = 0; chosen < slots && meets(taken[chosen]);) ++chosen;
            if (chosen == slots) {
                taken.emplace_back(tree.size() + 1);
                ++slots;
            }
            for (std::size_t k = 0; k < bordered.size(); ++k) taken[chosen][k] |= bordered[k];
            ending_[top + 1].push_back({c, chosen, moved[c][0]});
        }
    }

    int slots = 0;
    std::vector<int> slot;  // (n) -1 for a coordinate of one body

    // The mimic coordinates that are eliminated at body j, after its own; for j = -1, at the end.
    const std::vector<Mimic>& ending(int j) const { return ending_[j + 1]; }

  private:
    std::vector<std::vector<Mimic>> ending_;  // (b + 1)

    // The last body whose subtree has both; -1 if there is none.
    static int common(const Tree& tree, int i, int j) {
        while (i != j) {
            int& later = i > j ? i : j;
            later = tree.bodies[later].parent;
        }
        return i;
    }
};

// The storage cells in which bodies sum the contributions of their subtrees, from the last body to the first. Cells
// are reused: a chain needs one, which stays in the cache. The fixed base has a cell after those of bodies, for mimic
// joints.
struct SubtreeOrder {
    explicit SubtreeOrder(const Tree& tree)
        : mimics(tree), cell(tree.size() + 1, -1), joins(tree.size(), 0), leaf(tree.size() + 1, 1) {
        std::vector<int> free;
        for (int j = tree.size() - 1; j >= 0; --j) {
            if (cell[j] < 0) {
                if (free.empty()) free.push_back(cells++);
                cell[j] = free.back();
                free.pop_back();
            }
            int k = tree.bodies[j].parent;
            if (k < 0 && mimics.slots > 0) k = tree.size();
            if (k >= 0 && cell[k] < 0) {
                cell[k] = cell[j];
                leaf[k] = 0;
                continue;
            }
            joins[j] = k >= 0;
            free.push_back(cell[j]);
        }
    }

    Mimics mimics;
    int cells = 0;
    std::vector<int> cell;    // of each body; a first child has the cell of its parent
    std::vector<char> joins;  // has a cell of its own, which is added to that of its parent
    std::vector<char> leaf;   // has no children: its cell is empty
};

namespace detail {

// The contributions of subtrees during elimination, `entries` numbers in each cell.
class SubtreeSums {
  public:
    SubtreeSums(std::shared_ptr<const SubtreeOrder> order, int entries)
        : order_(std::move(order)), entries_(entries), at_(order_->cells * entries) {}

    // The sum of the children of body j.
    double* of(int j) {
        double* entries = of_again(j);
        if (order_->leaf[j]) std::fill(entries, entries + entries_, 0.0);
        return entries;
    }
    double* of_again(int j) { return at_.data() + order_->cell[j] * entries_; }
    // The sum of the roots, for mimic joints.
    double* of_ground() { return at_.data() + order_->cell.back() * entries_; }
    // Pass the contribution of body j to its parent.
    void hand_on(int j, int parent) {
        if (!order_->joins[j]) return;
        const double* entries = of_again(j);
        double* __restrict up = parent < 0 ? of_ground() : of_again(parent);
        for (int k = 0; k < entries_; ++k) up[k] += entries[k];
    }

  private:
    std::shared_ptr<const SubtreeOrder> order_;
    int entries_;
    std::vector<double> at_;
};

}  // namespace detail

}  // namespace varpin
